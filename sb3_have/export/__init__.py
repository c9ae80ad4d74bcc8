"""
Policies that leave the house: weights as safetensors, which no pickle is needed to read, and ONNX for other runtimes.

    export_safetensors(model, "policy")        # a folder, as on the Hugging Face Hub
    policy = load_policy("policy")             # executes nothing that the folder holds
    export_onnx(model, "policy.onnx")          # for onnxruntime, TensorRT and others

What it needs comes with ``pip install "sb3_have[export]"``.
"""

from sb3_have.export.onnx import export_onnx
from sb3_have.export.safetensors import export_safetensors, load_policy, read_config

__all__ = ["export_onnx", "export_safetensors", "load_policy", "read_config"]
