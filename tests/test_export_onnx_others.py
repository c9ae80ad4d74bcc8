"""ONNX files of policies with fused feature maps, and of other algorithms on the same encoders."""

from pathlib import Path
from typing import Any

import pytest
from envs import RandomSensors, image, tiny_model, vector
from gymnasium import spaces
from onnx_parity import assert_parity, enliven, metadata
from sb3_contrib import TQC

from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.encoders import MultiModalExtractor
from sb3_have.export import export_onnx

IMAGES = spaces.Dict({"rgb": image(3, 16), "event": image(2, 16)})


@pytest.mark.parametrize("fusion", ["transfuser", "efnet"])
def test_fused_feature_maps(tmp_path: Path, fusion: str) -> None:
    layers = {"layers": [(8, 4, 2), (8, 3, 1)]}
    kwargs: dict[str, Any] = {"fusion": fusion, "encoder_kwargs": {"rgb": layers, "event": layers}}
    model = tiny_model(IMAGES, kwargs)
    enliven(model.policy)
    for name, parameter in model.critic.encoder.fusions.named_parameters():
        if not parameter.any():  # what a fusion adds is zero at first
            parameter.data.normal_(std=0.1)
            assert "norm" in name or "projection" in name or "mlp" in name
    export_onnx(model, tmp_path / "policy.onnx")
    assert_parity(tmp_path / "policy.onnx", model.policy)


@pytest.mark.parametrize("algorithm", [TQC, MultiInputCrossQ])
def test_other_algorithms(tmp_path: Path, algorithm: Any) -> None:
    space = spaces.Dict({"event": image(2, 16), "state": vector(3)})
    policy_kwargs = {
        "features_extractor_class": MultiModalExtractor,
        "features_extractor_kwargs": {"features_dim": 8, "precision": "float32"},
        "normalize_images": False,
        "net_arch": [16],
    }
    model = algorithm(
        "MultiInputPolicy", RandomSensors(space), buffer_size=50, learning_starts=8, policy_kwargs=policy_kwargs, seed=0
    )
    model.learn(12)
    enliven(model.policy)
    export_onnx(model, tmp_path / "policy.onnx")
    assert_parity(tmp_path / "policy.onnx", model.policy)
    found = metadata(tmp_path / "policy.onnx")
    assert found["algorithm"] == algorithm.__name__ and found["frame_stack"] == 1 and "modalities" not in found
