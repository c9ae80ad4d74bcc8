"""The algorithms by name, and which of them saved a model."""

from __future__ import annotations

import json
import zipfile
from os import PathLike
from typing import IO

from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.have import HAVESAC

ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "havesac": HAVESAC,
    "sac": SAC,
    "tqc": TQC,
    "crossq": MultiInputCrossQ,
}

# The packages of the policies of each algorithm
POLICY_MODULES = {
    "sb3_have.have": "havesac",
    "stable_baselines3.sac": "sac",
    "sb3_have.common.tqc": "tqc",
    "sb3_contrib.tqc": "tqc",
    "sb3_have.common.crossq": "crossq",
    "sb3_contrib.crossq": "crossq",
}


def saved_algorithm(model: str | PathLike[str] | IO[bytes], name: object) -> str | None:
    """
    Return the name of the algorithm that saved a model, without unpickling anything.

    :param model: Zip file written by ``model.save``
    :param name: Name of the file in error messages
    :return: None for a policy class of the user's own
    :raises ValueError: If SB3 did not save the file, or another of its algorithms did
    """
    try:
        with zipfile.ZipFile(model) as archive:
            module = str(json.loads(archive.read("data"))["policy_class"]["__module__"])
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{name} is not a model that SB3 saved by `model.save(path)`, or it is damaged ({error}); a checkpoint has "
            "one in its model.zip"
        ) from error
    for prefix, algorithm in POLICY_MODULES.items():
        if module.startswith(prefix):
            return algorithm
    if module.startswith(("stable_baselines3.", "sb3_contrib.")):
        raise ValueError(f"{name}: its policy is from {module}; supported algorithms: {', '.join(sorted(ALGORITHMS))}")
    return None
