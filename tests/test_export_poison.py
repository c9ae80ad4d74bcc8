"""``load_policy`` executes nothing that a folder holds, wherever it lies."""

import base64
import contextlib
import io
import json
import os
import pickle
import sys
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import exported
import pytest
import torch as th
from envs import tiny_model, vectors_space

from sb3_have import HAVESAC
from sb3_have.export import export_safetensors, load_policy


class Poison:
    """An object that creates a folder when it is unpickled."""

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
    """Test the tests: the same bytes are executed where pickle reads them."""
    pickle.loads(pickle.dumps(Poison(marker)))
    assert marker.exists()
    marker.rmdir()
    th.load(io.BytesIO(torch_file(Poison(marker))), weights_only=False)
    assert marker.exists()
    marker.rmdir()
    # SB3 reads its zip so too, in the JSON of "data"
    tiny_model(vectors_space()).save(tmp_path / "model.zip")
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
def test_a_pickle_in_place_of_a_file_is_refused(folder: Path, marker: Path, name: str, form: str) -> None:
    (folder / name).write_bytes(FORMS[form](Poison(marker)))
    with pytest.raises(ValueError, match=rf"{name}: .*(JSON|header)"):
        load_policy(folder, "cpu")
    assert not marker.exists()


@pytest.mark.parametrize("form", FORMS)
def test_a_pickle_behind_the_weights_is_refused(folder: Path, marker: Path, form: str) -> None:
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes() + FORMS[form](Poison(marker)))
    with pytest.raises(ValueError, match=r"model\.safetensors: .*(?i:metadata)"):
        load_policy(folder, "cpu")
    assert not marker.exists()


def test_a_zip_of_sb3_is_refused(marker: Path, tmp_path: Path) -> None:
    tiny_model(vectors_space()).save(tmp_path / "model.zip")
    poison_sb3_zip(tmp_path / "model.zip", Poison(marker))
    with pytest.raises(NotADirectoryError, match=r"model\.zip"):
        load_policy(tmp_path / "model.zip", "cpu")
    assert not marker.exists()


def places(tree: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON tree."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


@pytest.mark.parametrize("form", ["serialized", "class", "object", "reduce"])
def test_poison_anywhere_in_the_configuration(
    folder: Path, marker: Path, form: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """In the form of SB3's JSON, and as names in a module that creates the marker when it is imported."""
    (tmp_path / "poisonous.py").write_text(f"import os\nos.mkdir({str(marker)!r})\nclass Encoder: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    payload: Any = {
        "serialized": {":type:": "x", ":serialized:": pickle.dumps(Poison(marker), 0).decode()},
        "class": {"$class": "poisonous.Encoder"},
        "object": {"$object": "poisonous.Encoder"},
        "reduce": {"$reduce": ["os.mkdir", [str(marker)]]},
    }[form]
    original, tensors = exported.read(folder)
    for place in places(original):
        config = json.loads(json.dumps(original))
        if not place:
            config = payload
        else:
            inside = config
            for key in place[:-1]:
                inside = inside[key]
            inside[place[-1]] = payload
        exported.write(folder, config, tensors)
        with contextlib.suppress(ValueError):  # nothing looks at the name of the algorithm, for example
            load_policy(folder, "cpu")
        assert not marker.exists(), place
        assert "poisonous" not in sys.modules


def test_poison_beside_the_policy_is_not_read(folder: Path, marker: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poison = Poison(marker)
    exported.write(folder, *exported.read(folder), poison=pickle.dumps(poison, 0).decode())
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
