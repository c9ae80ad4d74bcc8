"""``python -m sb3_have.export``: from SB3's zip, or from exported weights, to the formats of deployment."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs import RandomSensors, tiny_model, vector, vectors_space
from onnx_parity import metadata
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC

from sb3_have import HAVESAC
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.export import load_policy
from sb3_have.export.__main__ import load_zip, main


@pytest.fixture
def zipped(tmp_path: Path) -> Path:
    tiny_model(vectors_space(), buffer_size=10_000_000).save(tmp_path / "model.zip")
    return tmp_path / "model.zip"


def test_from_zip_to_safetensors_to_onnx(zipped: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, file = zipped.parent / "policy", zipped.parent / "policy.onnx"
    main([str(zipped), "--format", "safetensors", "--out", str(folder)])
    assert f"{folder}: 0." in capsys.readouterr().out
    observation = vectors_space().sample()
    actions = [
        one.predict(observation, deterministic=True)[0] for one in (HAVESAC.load(zipped), load_policy(folder, "cpu"))
    ]
    assert np.array_equal(actions[0], actions[1])
    main([str(folder), "--format", "onnx"])
    assert metadata(file)["frame_stack"] == 1
    assert f"{file}: 0." in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", [SAC, TQC, MultiInputCrossQ, HAVESAC])
def test_the_algorithm_is_found(tmp_path: Path, algorithm: Any) -> None:
    algorithm("MultiInputPolicy", RandomSensors(vectors_space()), buffer_size=50, policy_kwargs={"net_arch": [8]}).save(
        tmp_path / "model.zip"
    )
    assert type(load_zip(tmp_path / "model.zip")) is algorithm


def run(*arguments: Any) -> str:
    with pytest.raises(SystemExit) as exit:
        main(list(map(str, arguments)))
    return str(exit.value)


def test_wrong_files(tmp_path: Path, zipped: Path) -> None:
    to_onnx = ("--format", "onnx", "--out", tmp_path / "out")
    assert "nothing.zip" in run(tmp_path / "nothing.zip", *to_onnx)
    assert f"{tmp_path / 'config.json'}" in run(tmp_path, *to_onnx)
    (tmp_path / "text").write_text("text")
    assert "text is not a model that SB3 saved" in run(tmp_path / "text", *to_onnx)
    PPO("MlpPolicy", RandomSensors(vector(3)), device="cpu").save(tmp_path / "ppo.zip")
    assert "ppo.zip" in run(tmp_path / "ppo.zip", *to_onnx)
    assert "model.zip was saved by havesac, not by tqc" in run(zipped, *to_onnx, "--algo", "tqc")
    assert f"File exists: '{zipped}'" in run(zipped, "--format", "safetensors", "--out", zipped)
    (tmp_path / "policy").mkdir()
    assert "only a zip can be exported as safetensors" in run(tmp_path / "policy", "--format", "safetensors")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["model_vecnormalize_200_steps.pkl", "ReliabilityDrive-v0/vecnormalize.pkl"])
def test_statistics_beside_the_zip_are_reported(zipped: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """SB3's CheckpointCallback and the Zoo save them so."""
    main([str(zipped), "--format", "safetensors"])
    assert not capsys.readouterr().err
    (zipped.parent / name).parent.mkdir(exist_ok=True)
    (zipped.parent / name).touch()
    main([str(zipped), "--format", "safetensors"])
    assert f"{zipped.parent / name}: if the model was trained under VecNormalize" in capsys.readouterr().err
