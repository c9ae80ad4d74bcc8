"""``python -m sb3_have.export``: from SB3's zip, or from exported weights, to the formats of deployment."""

import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs import RandomSensors, tiny_model, vector, vectors_space
from gymnasium import spaces
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
    assert "nothing.zip: no such file, nor a folder with config.json" in run(tmp_path / "nothing.zip", *to_onnx)
    assert f"{tmp_path}: no such file, nor a folder" in run(tmp_path, *to_onnx)
    (tmp_path / "text").write_text("text")
    assert "text is not a model that SB3 saved by `model.save(path)`" in run(tmp_path / "text", *to_onnx)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("policy.pth", b"")
    assert "other.zip is not a model that SB3 saved" in run(tmp_path / "other.zip", *to_onnx)
    PPO("MlpPolicy", RandomSensors(vector(3)), device="cpu").save(tmp_path / "ppo.zip")
    assert "ppo.zip: its policy is from stable_baselines3.common.policies; supported" in run(
        tmp_path / "ppo.zip", *to_onnx
    )
    assert "model.zip: its policy is of havesac, not of tqc" in run(zipped, *to_onnx, "--algo", "tqc")
    with zipfile.ZipFile(zipped) as archive, zipfile.ZipFile(tmp_path / "half.zip", "w") as half:
        half.writestr("data", archive.read("data"))
    assert "half.zip cannot be loaded: KeyError" in run(tmp_path / "half.zip", *to_onnx)
    assert "expected the name of a folder" in run(zipped, "--format", "safetensors", "--out", zipped)
    assert not (tmp_path / "out").exists()


def test_weights_are_not_exported_twice(zipped: Path) -> None:
    main([str(zipped), "--format", "safetensors"])
    folder = zipped.parent / "model_safetensors"
    assert "has been exported as safetensors already" in run(folder, "--format", "safetensors")
    sac = SAC("MultiInputPolicy", RandomSensors(spaces.Dict({"a": vector(2), "b": spaces.Discrete(2)})), buffer_size=50)
    sac.save(zipped)
    assert "only Box spaces and Dicts of them are exported" in run(zipped, "--format", "safetensors")


@pytest.mark.parametrize("name", ["model_vecnormalize_200_steps.pkl", "ReliabilityDrive-v0/vecnormalize.pkl"])
def test_statistics_beside_the_zip_are_told(zipped: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """As SB3's CheckpointCallback and as the Zoo save them."""
    main([str(zipped), "--format", "safetensors"])
    assert not capsys.readouterr().err
    (zipped.parent / name).parent.mkdir(exist_ok=True)
    (zipped.parent / name).touch()
    main([str(zipped), "--format", "safetensors"])
    assert f"{zipped.parent / name} suggests that it was trained under VecNormalize" in capsys.readouterr().err


def test_help_warns_of_pickle(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["export", "--help"])
    with pytest.raises(SystemExit):
        main()
    told = " ".join(capsys.readouterr().out.split())
    assert "unpickles the file and so executes what that holds, so give only one that you trust" in told
