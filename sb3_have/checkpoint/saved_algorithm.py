"""Which algorithm saved a model."""

from __future__ import annotations

import json
import zipfile
from os import PathLike
from typing import IO, Any

SAVED_BY = {
    "sb3_have.have": "havesac",
    "sb3_have.common.crossq": "crossq",
    "sb3_contrib.crossq": "crossq",
    "sb3_contrib.tqc": "tqc",
    "stable_baselines3.sac": "sac",
}
"""Algorithms by the module of their policies."""


def saved_algorithm(model: str | PathLike[str] | IO[bytes], name: object) -> str | None:
    """The algorithm that saved a model, None for a policy of a user's own; nothing is unpickled to tell.

    :param model: the zip of ``model.save``
    :param name: of its file, for the errors
    :raises ValueError: if SB3 did not save it, or for another algorithm of SB3's
    """
    try:
        with zipfile.ZipFile(model) as archive:
            data: dict[str, Any] = json.loads(archive.read("data"))
        module = str(data["policy_class"]["__module__"])
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name} is not a model that SB3 saved by `model.save(path)`, or it is damaged ({error}); a checkpoint has "
            "one in its model.zip"
        ) from error
    found = next((algo for prefix, algo in SAVED_BY.items() if module.startswith(prefix)), None)
    if found is None and module.startswith(("stable_baselines3.", "sb3_contrib.")):
        known = ", ".join(sorted(set(SAVED_BY.values())))
        raise ValueError(f"{name}: its policy is of {module}, and only those of {known} are known here")
    return found
