"""
Policies for deployment: safetensors, which are read without unpickling anything, and ONNX for other runtimes::

    export_safetensors(model, "policy")
    policy = load_policy("policy")
    export_onnx(model, "policy.onnx")

ONNX needs ``pip install "sb3_have[export]"``. Checkpoints to resume a training from are in :mod:`sb3_have.checkpoint`.
"""

from sb3_have.export.onnx import export_onnx
from sb3_have.export.safetensors import export_safetensors, load_policy, read_config

__all__ = ["export_onnx", "export_safetensors", "load_policy", "read_config"]
