"""ONNX files of HAVESAC's policies: the same actions and weights as PyTorch, and metadata."""

import gc
import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch as th
from envs import RandomSensors, image, sensors_space, tiny_model, vector, vectors_space
from gymnasium import spaces
from onnx_parity import Uneven, assert_parity, enliven, input_types, metadata
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from torch._subclasses import FakeTensorMode

import sb3_have
from sb3_have import HAVESAC
from sb3_have.export import export_onnx, export_safetensors, load_policy


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> tuple[HAVESAC, Path]:
    """Two frames of images and a vector; gSDE, and image encoders in bfloat16."""
    env = VecFrameStack(DummyVecEnv([lambda: Uneven(sensors_space())]), 2)
    model = tiny_model(sensors_space(), {"precision": "bfloat16"}, env=env, use_sde=True)
    enliven(model.policy)
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    export_onnx(model, path)
    return model, path


def test_images_and_vectors(mixed: tuple[HAVESAC, Path]) -> None:
    model, path = mixed
    encoder = model.critic.encoder
    assert encoder.precision == "bfloat16"  # as it was before
    encoder.precision = "float32"
    assert_parity(path, model.policy)
    encoder.precision = "bfloat16"


def test_inputs_and_outputs(mixed: tuple[HAVESAC, Path]) -> None:
    _, path = mixed
    assert input_types(path) == {
        "event": ("tensor(uint8)", ["batch", 10, 36, 36]),
        "rgb": ("tensor(uint8)", ["batch", 6, 36, 36]),
        "state": ("tensor(float)", ["batch", 8]),
    }
    proto = onnx.load(path)
    onnx.checker.check_model(proto, full_check=True)
    outputs = {
        output.name: [dim.dim_param or dim.dim_value for dim in output.type.tensor_type.shape.dim]
        for output in proto.graph.output
    }
    assert outputs == {"action": ["batch", 2, 3], "weights": ["batch", 3]}
    types = {tensor.data_type for tensor in proto.graph.initializer}
    assert onnx.TensorProto.BFLOAT16 not in types and onnx.TensorProto.FLOAT16 not in types


def test_metadata(mixed: tuple[HAVESAC, Path]) -> None:
    _, path = mixed
    found = metadata(path)
    assert found["algorithm"] == "HAVESAC" and found["value_estimation"] == "have"
    assert found["modalities"] == {"event": ["event"], "rgb": ["rgb"], "state": ["state"]}
    assert found["frame_stack"] == 2 and found["frame_order"].startswith("oldest first")
    assert found["action_space"]["low"] == [[-2, 0, 5], [-1, -1, -1]]
    assert found["action_space"]["high"] == [[1, 7, 6], [1, 0, 3]]
    assert [key for key, _ in found["observation_space"]["spaces"]] == ["event", "rgb", "state"]
    assert found["versions"]["sb3_have"] == sb3_have.__version__
    # no paths of the machine that wrote it
    content = path.read_bytes()
    for place in (sb3_have.__file__, str(Path(th.__file__).parent), str(path.parent)):
        assert place.encode() not in content


def test_vectors_and_modalities_of_several_keys(tmp_path: Path) -> None:
    """Keys that are no Python names, or the names of operators in the graph; doubles stay doubles."""
    space = spaces.Dict(
        {
            "left wheel/speed": vector(2),
            "linear": vector(3),
            "tanh": spaces.Box(-np.inf, np.inf, (2, 2), np.float64),
            "add": spaces.Box(0, 9, (2,), np.int64),
        }
    )
    modalities = {"wheels": ["left wheel/speed", "linear"], "rest": ["tanh", "add"]}
    model = tiny_model(space, {"modalities": modalities}, value_estimation="lve")
    enliven(model.policy)
    export_safetensors(model, tmp_path / "policy")
    policy = load_policy(tmp_path / "policy", "cpu")
    path = tmp_path / "policy.onnx"
    export_onnx(policy, path, frame_stack=4)
    assert_parity(path, model.policy)
    found, types = metadata(path), input_types(path)
    assert found["modalities"] == modalities and found["frame_stack"] == 4 and found["algorithm"] is None
    assert types["tanh"] == ("tensor(double)", ["batch", 2, 2]) and types["add"] == ("tensor(int64)", ["batch", 2])


def test_shapes_of_exports_are_freed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyTorch would keep the shapes of every export, about 1 MB in thousands of objects."""
    # pytest attaches its handlers to this logger, and would keep the messages
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "handlers", [])
    model = tiny_model(sensors_space())
    alive = []
    for _ in range(3):
        export_onnx(model, tmp_path / "policy.onnx")
        gc.collect()
        alive.append(len(gc.get_objects()))
    assert alive[2] - alive[1] < 1500
    assert FakeTensorMode.cache_info().size == 0


def test_a_single_image(tmp_path: Path) -> None:
    model = tiny_model(image(2, 16), value_estimation="gve")
    enliven(model.policy)
    path = tmp_path / "new" / "policy.onnx"
    export_onnx(model, path)
    path.write_bytes(b"an older file")
    export_onnx(model, path)
    assert_parity(path, model.policy)
    assert input_types(path) == {"observation": ("tensor(uint8)", ["batch", 2, 16, 16])}
    assert [file.name for file in path.parent.iterdir()] == ["policy.onnx"]


class Contrary(sb3_have.MultiModalPolicy):
    """Does not act as its actor does."""

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return -super()._predict(observation, deterministic)


def test_a_policy_that_acts_otherwise_is_refused(tmp_path: Path) -> None:
    model = HAVESAC(Contrary, RandomSensors(vectors_space()), buffer_size=10, policy_kwargs={"net_arch": [8]})
    with pytest.raises(ValueError, match=r"the actions of Contrary in onnxruntime differ from `predict`"):
        export_onnx(model, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_keys_with_the_name_of_an_output_are_refused(tmp_path: Path) -> None:
    model = tiny_model(spaces.Dict({"action": vector(2), "a": vector(2)}))
    with pytest.raises(ValueError, match="observation key 'action' is the name of an output"):
        export_onnx(model, tmp_path / "policy.onnx")
