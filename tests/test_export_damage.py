"""Damaged files are refused, and the error names the file and what is wrong with it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import exported
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
WEIGHTS: dict[str, tuple[Damage, str]] = {
    "missing tensor": (drop(BIAS), r'Missing key\(s\).* "actor\.mu\.bias"'),
    "extra tensor": (put("actor.more", th.zeros(1)), r'Unexpected key\(s\).* "actor\.more"'),
    "wrong shape": (put(BIAS, th.zeros(3)), r"size mismatch for actor\.mu\.bias: .*\[3\]"),
    "wrong dtype": (put(BIAS, th.zeros(2).half()), r"actor\.mu\.bias is of torch\.float16, expected torch\.float32"),
    "nan": (put(BIAS, th.tensor([0.0, np.nan])), r"NaN or infinity in actor\.mu\.bias"),
    "infinite": (put(BIAS, th.tensor([-np.inf, np.inf])), r"NaN or infinity in actor\.mu\.bias"),
    "wrong size": (set_in("policy_kwargs", "features_dim", value=9), r"size mismatch for critic\.encoder"),
}
CONFIG: dict[str, tuple[Damage, str]] = {
    "newer": (set_in("format_version", value=2), "format_version 2, expected 1: upgrade"),
    "no version": (drop("format_version"), "'format_version'"),
    "true version": (set_in("format_version", value=True), "format_version True, expected 1"),
    "no spaces": (drop("observation_space"), "'observation_space'"),
    "kwargs": (set_in("policy_kwargs", value=[1]), "'list' object"),
    "unknown argument": (set_in("policy_kwargs", "colour", value=1), "'colour'"),
    "wrong argument": (set_in("policy_kwargs", "features_dim", value="x"), "TypeError"),
    "no policy": (set_in("policy_class", value={"$class": "torch.nn.ReLU"}), "TypeError"),
    "action shape": (set_in("action_space", "shape", value=[2, 3, "x"]), "action_space is damaged"),
    "huge action": (set_in("action_space", "shape", value=[10**5, 10**6]), "action_space is damaged: more than"),
    "huge keys": (
        set_in("observation_space", "spaces", value=[[key, HUGE] for key in "abc"]),
        "observation_space is damaged: more than",
    ),
    "negative keys": (
        set_in("observation_space", "spaces", value=[["a", HUGE | {"shape": [-(10**9)]}], ["b", HUGE], ["c", HUGE]]),
        "observation_space is damaged: more than",
    ),
    "negative twice": (set_in("action_space", "shape", value=[-2, -1]), "action_space is damaged: .*non-negative"),
    "fractional": (set_in("action_space", "shape", value=[2.0]), "action_space is damaged: 'float'"),
    "nested keys": (
        set_in(
            "observation_space", "spaces", value=[["a", {"type": "Dict", "shape": [], "spaces": [["b", HUGE]] * 9}]]
        ),
        "observation_space is damaged",
    ),
    **{
        f"huge {name}": (set_in("policy_kwargs", name, value=value), "more than twice the parameters")
        for name, value in {
            "net_arch": {"pi": [10**6, 10**6], "qf": [8]},  # 4 TB, which are not even asked for
            "features_dim": 10**6,
            "attention_dim": 10**6,
            "n_critics": 10**4,
            "encoder_kwargs": {"a": {"net_arch": [10**6, 10**6]}},
        }.items()
    },
    "nesting": (set_in("policy_kwargs", "net_arch", value=nested(450)), "cannot build"),
    "action bounds": (set_in("action_space", "low", value=[1, 2, 3]), "action_space is damaged"),
    "action dtype": (set_in("action_space", "dtype", value="object"), "action_space is damaged: .*dtype object"),
    "huge dtype": (set_in("action_space", "dtype", value="V2000000000"), "action_space is damaged: .*dtype V2"),
    "action type": (
        set_in("action_space", value={"type": "Discrete", "n": 3, "start": 0, "dtype": "int64"}),
        "expected a Box, got Discr",
    ),
    "space type": (set_in("action_space", "type", value="Text"), "action_space is damaged: unknown space Text"),
    "space of choices": (
        set_in("observation_space", value={"type": "Discrete", "n": 0, "start": 0, "dtype": "int64"}),
        "is damaged",
    ),
    "huge space of choices": (
        set_in("observation_space", value={"type": "Discrete", "n": 2 * 10**8, "start": 0, "dtype": "int64"}),
        "observation_space is damaged: more than",
    ),
    "huge space of bits": (
        set_in("observation_space", value={"type": "MultiBinary", "n": 2 * 10**8}),
        "is damaged: more than",
    ),
    "keys": (set_in("observation_space", "spaces", value=[["a"]]), "observation_space is damaged"),
    "unknown mark": (set_in("policy_kwargs", "net_arch", value={"$file": "x"}), "net_arch"),
}


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    export_safetensors(tiny_model(vectors_space()), folder)
    return folder


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy of an exported policy, to be damaged."""
    for file in original.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def test_rewriting_alone_damages_nothing(folder: Path) -> None:
    exported.write(folder, *exported.read(folder))
    load_policy(folder, "cpu")


@pytest.mark.parametrize("name", [*WEIGHTS, *CONFIG])
def test_damaged_contents_are_refused(folder: Path, name: str) -> None:
    damage, message = (WEIGHTS | CONFIG)[name]
    config, tensors = exported.read(folder)
    damage(config, tensors)
    exported.write(folder, config, tensors)
    with pytest.raises(ValueError, match=f"(?s){message}") as error:
        load_policy(folder, "cpu")
    assert str(error.value).startswith(str(folder / ("model.safetensors" if name in WEIGHTS else "config.json")))


@pytest.mark.parametrize(
    ("name", "length"),
    [(name, length) for name in ("config.json", "model.safetensors") for length in (0, 7, 8, 100, -2)]
    + [("model.safetensors", 5000)],
)
def test_truncated_files_are_refused(folder: Path, name: str, length: int) -> None:
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[:length])
    with pytest.raises(ValueError, match=r"header|metadata|JSON") as error:
        load_policy(folder, "cpu")
    assert str(folder / name) in str(error.value)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[1]", b'{"a": ', b"[" * 100_000, b'"x"'])
def test_other_json_is_refused(folder: Path, content: bytes) -> None:
    (folder / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"config\.json: not valid JSON|config\.json and .* not written together"):
        load_policy(folder, "cpu")


def test_files_of_two_exports_are_not_mixed(folder: Path) -> None:
    config = (folder / "config.json").read_text().replace('"float32"', '"float16"')
    (folder / "config.json").write_text(config)
    with pytest.raises(ValueError, match=r"config\.json and model\.safetensors were not written together"):
        load_policy(folder, "cpu")


def test_sizes_are_limited(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = folder / "model.safetensors"
    file.write_bytes((100_000_001).to_bytes(8, "little") + b"{" + b" " * 100)
    with pytest.raises(ValueError, match=r"model\.safetensors: .*(?i:too ?large)"):
        load_policy(folder, "cpu")
    monkeypatch.setattr("sb3_have.export.safetensors.MAX_CONFIG_SIZE", 100)
    with pytest.raises(ValueError, match=r"config\.json: \d+ bytes, more than 100"):
        load_policy(folder, "cpu")


def test_a_failed_export_leaves_the_last_one(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_the_disk(tensors: Any, path: Path, metadata: Any) -> None:
        path.write_bytes(b"half a fi")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(safetensors.torch, "save_file", fill_the_disk)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(OSError, match="No space left"):
        export_safetensors(tiny_model(vectors_space(), {"attention_dim": 5}), folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_a_policy_that_diverged_is_not_exported(tmp_path: Path) -> None:
    model = tiny_model(vectors_space())
    mu: Any = model.actor.mu
    mu.bias.data[1] = th.nan
    with pytest.raises(ValueError, match=r"MultiModalPolicy: NaN or infinity in actor\.mu\.bias"):
        export_safetensors(model, tmp_path / "policy")
    assert not (tmp_path / "policy").exists()
