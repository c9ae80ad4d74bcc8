"""A folder that does not hold a whole policy says so: which file, which tensor, what was expected, what to do."""

import json
import sys
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch as th
from envs import tiny_model, vectors_space

from sb3_have.export import export_safetensors, load_policy

Damage = Callable[[dict[str, Any], dict[str, th.Tensor]], None]


def set_in(*keys: str, value: Any) -> Damage:
    def damage(config: dict[str, Any], tensors: dict[str, th.Tensor]) -> None:
        for key in keys[:-1]:
            config = config[key]
        config[keys[-1]] = value

    return damage


def drop(name: str) -> Damage:
    def damage(config: dict[str, Any], tensors: dict[str, th.Tensor]) -> None:
        del (tensors if name in tensors else config)[name]

    return damage


def put(name: str, tensor: th.Tensor) -> Damage:
    return lambda config, tensors: tensors.update({name: tensor})


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


BIAS = "actor.mu.bias"
HUGE = {"type": "Box", "shape": [4 * 10**7], "dtype": "float32", "low": 0, "high": 1}
DAMAGES: dict[str, tuple[Damage, str]] = {
    "missing tensor": (drop(BIAS), r"lacks 'actor\.mu\.bias'; .*export it again"),
    "extra tensor": (put("actor.more", th.zeros(1)), r"also has 'actor\.more'"),
    "wrong shape": (put(BIAS, th.zeros(3)), r"'actor\.mu\.bias': expected float32 \(2,\), found float32 \(3,\)"),
    "wrong dtype": (put(BIAS, th.zeros(2).half()), r"'actor\.mu\.bias': expected float32 \(2,\), found float16 \(2,\)"),
    "nan": (put(BIAS, th.tensor([0.0, np.nan])), r"'actor\.mu\.bias': expected finite .* found 1 of 2 .*diverged"),
    "infinite": (put(BIAS, th.tensor([-np.inf, np.inf])), r"'actor\.mu\.bias'.* found 2 of 2 "),
    "newer": (set_in("format_version", value=2), r"format_version 2, written by sb3_have 0\..*reads up to 1: upgrade"),
    "no version": (drop("format_version"), r"'format_version' is None, expected int"),
    "true version": (set_in("format_version", value=True), r"'format_version' is True, expected int"),
    "no spaces": (drop("observation_space"), r"'observation_space' is None, expected dict"),
    "kwargs": (set_in("policy_kwargs", value=[1]), r"'policy_kwargs' is \[1\], expected dict"),
    "unknown argument": (set_in("policy_kwargs", "colour", value=1), r"MultiModalPolicy cannot be built.*'colour'"),
    "wrong argument": (set_in("policy_kwargs", "features_dim", value="x"), r"MultiModalPolicy cannot be built"),
    "wrong size": (
        set_in("policy_kwargs", "features_dim", value=9),
        r"expected float32 \(.*9.*\), found float32 \(.*8",
    ),
    "action shape": (set_in("action_space", "shape", value=[2, 3, "x"]), r"action_space is damaged"),
    "huge action": (set_in("action_space", "shape", value=[10**5, 10**6]), r"action_space is damaged: .*more than"),
    "huge keys": (
        set_in("observation_space", "spaces", value=[[key, dict(HUGE)] for key in "abc"]),
        r"observation_space is damaged: its spaces have more than",
    ),
    "negative keys": (
        set_in("observation_space", "spaces", value=[["a", HUGE | {"shape": [-(10**9)]}], ["b", HUGE], ["c", HUGE]]),
        r"observation_space is damaged: shape \[-1000000000\], expected whole numbers from 0 on",
    ),
    "negative twice": (set_in("action_space", "shape", value=[-2, -1]), r"damaged: shape \(-2, -1\), expected whole"),
    "fractional": (set_in("action_space", "shape", value=[2.0]), r"damaged: shape \(2.0,\), expected whole numbers"),
    "nested keys": (
        set_in(
            "observation_space", "spaces", value=[["a", {"type": "Dict", "shape": [], "spaces": [["b", HUGE]] * 9}]]
        ),
        r"observation_space is damaged: a Dict of something else than Boxes",
    ),
    **{
        f"huge {name}": (set_in("policy_kwargs", name, value=value), "its parameters are more than twice those of")
        for name, value in {
            "net_arch": {"pi": [10**6, 10**6], "qf": [8]},  # 4 TB, which are not even asked for
            "features_dim": 10**6,
            "attention_dim": 10**6,
            "n_critics": 10**4,
            "encoder_kwargs": {"a": {"net_arch": [10**6, 10**6]}},
        }.items()
    },
    "nesting": (set_in("policy_kwargs", "net_arch", value=nested(450)), r"nested too deep|cannot be built"),
    "action bounds": (set_in("action_space", "low", value=[1, 2, 3]), r"action_space is damaged"),
    "action dtype": (set_in("action_space", "dtype", value="object"), r"action_space is damaged: .*'object'"),
    "action type": (set_in("action_space", "type", value="Discrete"), r"action_space is damaged: type 'Discrete'"),
    "keys": (set_in("observation_space", "spaces", value=[["a"]]), r"observation_space is damaged"),
    "unknown mark": (set_in("policy_kwargs", "net_arch", value={"$file": "x"}), r"policy_kwargs\['net_arch'\] is 'x'"),
}


def rewrite(folder: Path, damage: Damage) -> None:
    """Change what is in the two files, so that they still belong together."""
    config = json.loads((folder / "config.json").read_text())
    tensors = safetensors.torch.load_file(folder / "model.safetensors")
    damage(config, tensors)
    write_pair(folder, json.dumps(config).encode(), tensors)


def write_pair(folder: Path, config: bytes, tensors: dict[str, th.Tensor]) -> None:
    (folder / "config.json").write_bytes(config)
    metadata = {"format": "pt", "config_sha256": sha256(config).hexdigest()}
    safetensors.torch.save_file(tensors, folder / "model.safetensors", metadata)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    export_safetensors(tiny_model(vectors_space()), folder)
    return folder


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    """A copy of an exported policy, to be damaged."""
    for file in exported.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_rewriting_alone_damages_nothing(folder: Path) -> None:
    rewrite(folder, lambda config, tensors: None)
    load_policy(folder, "cpu")


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_contents_are_refused_by_name(folder: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    rewrite(folder, damage)
    with pytest.raises(ValueError, match=message) as error:
        load_policy(folder, "cpu")
    file = "model.safetensors" if "tensor" in name or name in ("nan", "infinite") or "wrong " in name else "config.json"
    file = "config.json" if name == "wrong argument" else file
    assert str(error.value).startswith(str(folder / file))


@pytest.mark.parametrize(
    ("name", "length"),
    [(name, length) for name in ("config.json", "model.safetensors") for length in (0, 7, 8, 100, -2)]
    + [("model.safetensors", 5000)],
)
def test_truncated_files_are_refused_by_name(folder: Path, name: str, length: int) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[:length])  # the last byte of the configuration is its line break
    with pytest.raises(ValueError, match=r"again") as error:
        load_policy(folder, "cpu")
    assert str(folder / name) in str(error.value)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[1]", b'{"a": ', b"[" * 100_000, b'"x"'])
def test_other_json_is_refused(folder: Path, content: bytes) -> None:
    (folder / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json: not the JSON of export_safetensors"):
        load_policy(folder, "cpu")


def test_missing_files_are_named(folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere.config\.json: no such file"):
        load_policy(folder / "nowhere", "cpu")
    (folder / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors: no such file"):
        load_policy(folder, "cpu")


def test_files_of_two_exports_are_not_mixed(folder: Path) -> None:
    config = json.loads((folder / "config.json").read_text())
    config["policy_kwargs"]["precision"] = "bfloat16"
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"model\.safetensors: it was not written together with this config\.json"):
        load_policy(folder, "cpu")


def test_headers_beyond_the_limit_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "model.safetensors"
    file.write_bytes((100_000_001).to_bytes(8, "little") + b"{" + b" " * 100)
    with pytest.raises(ValueError, match=r"model\.safetensors: 109 bytes .*too large"):
        load_policy(folder, "cpu")
    monkeypatch.setattr("sb3_have.export.safetensors.MAX_HEADER_SIZE", 100)
    with pytest.raises(ValueError, match=r"config\.json: \d+ bytes, over the limit of 100"):
        load_policy(folder, "cpu")
    with pytest.raises(ValueError, match=r"\d+ bytes, over the limit of 100"):
        export_safetensors(tiny_model(vectors_space()), folder)


def test_a_failed_export_leaves_the_last_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model(vectors_space(), {"attention_dim": 5})  # and so another configuration

    def fill_the_disk(tensors: Any, path: Path, metadata: Any) -> None:
        path.write_bytes(b"half a fi")
        raise OSError(28, "No space left on device")

    for writer in (fill_the_disk, lambda tensors, path, metadata: path.write_bytes(b"\xff" * 20)):
        monkeypatch.setattr(safetensors.torch, "save_file", writer)
        before = {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix != ".partial"}
        with pytest.raises((OSError, ValueError), match=r"No space left|not a whole safetensors file"):
            export_safetensors(model, folder)
        assert {name: (folder / name).read_bytes() for name in before} == before
    load_policy(folder, "cpu")


def test_what_cannot_be_exported(tmp_path: Path) -> None:
    model = tiny_model(vectors_space())
    for name in ("policy.safetensors", "policy.zip"):
        with pytest.raises(ValueError, match="expected the name of a folder"):
            export_safetensors(model, tmp_path / name)
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="expected the name of a folder"):
        export_safetensors(model, tmp_path / "file")
    mu: Any = model.actor.mu
    mu.bias.data[1] = th.nan
    with pytest.raises(ValueError, match=r"MultiModalPolicy: tensor 'actor\.mu\.bias': expected finite.*found 1 of 2"):
        export_safetensors(model, tmp_path / "policy")
    assert not (tmp_path / "policy").exists()


def test_without_the_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model(vectors_space())
    monkeypatch.setitem(sys.modules, "safetensors", None)
    for call in (lambda: load_policy(folder), lambda: export_safetensors(model, folder)):
        with pytest.raises(ImportError, match=r'pip install "sb3_have\[export\]"'):
            call()
