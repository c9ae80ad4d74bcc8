"""Nothing that lies in a folder of ``export_safetensors`` is executed by ``load_policy``, wherever it lies."""

import base64
import contextlib
import io
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch as th
from envs import tiny_model, vectors_space

from sb3_have import HAVESAC
from sb3_have.export import export_safetensors, load_policy


class Poison:
    """An object whose unpickling makes a file."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.marker),)


def torch_file(poison: Poison) -> bytes:
    buffer = io.BytesIO()
    th.save({"state_dict": poison}, buffer)
    return buffer.getvalue()


def zip_file(poison: Poison) -> bytes:
    """As SB3 writes them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("data", pickle.dumps(poison))
        archive.writestr("policy.pth", torch_file(poison))
    return buffer.getvalue()


def behind_the_weights(folder: Path, payload: bytes) -> bytes:
    return (folder / "model.safetensors").read_bytes() + payload


FORMS: dict[str, Callable[[Poison], bytes]] = {
    "pickle": pickle.dumps,
    "protocol 0": lambda poison: pickle.dumps(poison, 0),
    "torch": torch_file,
    "zip": zip_file,
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    export_safetensors(tiny_model(vectors_space()), tmp_path / "policy")
    return tmp_path / "policy"


@pytest.fixture
def marker(tmp_path: Path) -> Path:
    return tmp_path / "executed"


def test_the_payload_works(marker: Path, tmp_path: Path) -> None:
    """The test of the tests: the same bytes do execute where pickle reads them."""
    pickle.loads(pickle.dumps(Poison(marker)))
    assert marker.exists()
    marker.rmdir()
    th.load(io.BytesIO(torch_file(Poison(marker))), weights_only=False)
    assert marker.exists()
    marker.rmdir()
    # and where SB3 reads its zip: in the JSON of "data"
    model = tiny_model(vectors_space())
    model.save(tmp_path / "model.zip")
    poison_sb3_zip(tmp_path / "model.zip", Poison(marker))
    HAVESAC.load(tmp_path / "model.zip", device="cpu")
    assert marker.exists()


def poison_sb3_zip(path: Path, poison: Poison) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    data["extra"] = {":type:": "x", ":serialized:": base64.b64encode(pickle.dumps(poison)).decode()}
    members["data"] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_pickle_in_a_files_place_is_refused(folder: Path, marker: Path, name: str, form: str) -> None:
    (folder / name).write_bytes(FORMS[form](Poison(marker)))
    with pytest.raises(ValueError, match=r"export .*again|copy or export it again"):
        load_policy(folder, "cpu")
    assert not marker.exists()


@pytest.mark.parametrize("form", FORMS)
def test_a_pickle_behind_the_weights_is_refused(folder: Path, marker: Path, form: str) -> None:
    (folder / "model.safetensors").write_bytes(behind_the_weights(folder, FORMS[form](Poison(marker))))
    with pytest.raises(ValueError, match="not a whole safetensors file"):
        load_policy(folder, "cpu")
    assert not marker.exists()


def test_a_zip_of_sb3_is_refused(marker: Path, tmp_path: Path) -> None:
    tiny_model(vectors_space()).save(tmp_path / "model.zip")
    poison_sb3_zip(tmp_path / "model.zip", Poison(marker))
    with pytest.raises(ValueError, match=r"model\.zip is a file, expected a folder.*HAVESAC\.load"):
        load_policy(tmp_path / "model.zip", "cpu")
    assert not marker.exists()


def rewrite(folder: Path, config: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
    """Both files with this configuration, belonging together."""
    tensors = safetensors.torch.load_file(folder / "model.safetensors")
    content = json.dumps(config).encode()
    (folder / "config.json").write_bytes(content)
    safetensors.torch.save_file(
        tensors, folder / "model.safetensors", {"config_sha256": sha256(content).hexdigest(), **(metadata or {})}
    )


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place of a JSON tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


@pytest.mark.parametrize("form", ["serialized", "class", "given", "reduce"])
def test_poison_anywhere_in_the_configuration(
    folder: Path, marker: Path, form: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In the form of SB3's JSON, and as names of a module that would leave the marker when it is imported."""
    (tmp_path / "poisonous.py").write_text(f"import os\nos.mkdir({str(marker)!r})\nclass Encoder: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    payload: Any = {
        "serialized": {":type:": "x", ":serialized:": pickle.dumps(Poison(marker), 0).decode()},
        "class": {"$class": "poisonous.Encoder"},
        "given": {"$given": "poisonous.Encoder"},
        "reduce": {"$reduce": ["os.mkdir", [str(marker)]]},
    }[form]
    original = json.loads((folder / "config.json").read_text())
    for place in places(original):
        config = json.loads(json.dumps(original))
        if not place:
            config = payload
        else:
            inside = config
            for key in place[:-1]:
                inside = inside[key]
            inside[place[-1]] = payload
        rewrite(folder, config)
        with contextlib.suppress(ValueError):  # in most places; the name of the algorithm, say, is not looked at
            load_policy(folder, "cpu")
        assert not marker.exists(), place
        assert "poisonous" not in sys.modules


def test_poison_beside_the_policy_is_not_read(folder: Path, marker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poison = Poison(marker)
    rewrite(folder, json.loads((folder / "config.json").read_text()), {"poison": pickle.dumps(poison, 0).decode()})
    for name in ("model.zip", "policy.pth", "model.pkl", "pytorch_model.bin", "config.json.partial", "__init__.py"):
        (folder / name).write_bytes(FORMS["zip" if name.endswith(("zip", "pth", "bin")) else "pickle"](poison))

    def refuse(*args: Any, **kwargs: Any) -> Any:
        raise AssertionError("load_policy unpickles")

    for module, name in [
        (pickle, "load"),
        (pickle, "loads"),
        (pickle, "Unpickler"),
        (import_module("cloudpickle"), "loads"),
        (th, "load"),
    ]:
        monkeypatch.setattr(module, name, refuse)
    load_policy(folder, "cpu")
    assert not marker.exists()
