"""
The configuration of a policy as JSON: its class, the arguments of its constructor and its spaces.

A file may only name the classes in ``CLASSES``, so reading one imports nothing. Other classes are passed to
:func:`~sb3_have.export.load_policy`.
"""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np
from gymnasium import spaces
from sb3_contrib.crossq.policies import CrossQPolicy
from sb3_contrib.tqc import policies as tqc
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.common.utils import ConstantSchedule
from stable_baselines3.sac import policies as sac
from torch import nn, optim
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.nn.parameter import is_lazy

from sb3_have.common import crossq
from sb3_have.common.buffers import stacked_frames
from sb3_have.common.encoders import ImageEncoder, MultiModalExtractor, VectorEncoder
from sb3_have.common.fusion import CrossModalChannelAttention, Transfuser
from sb3_have.common.tqc import MultiModalTQCPolicy
from sb3_have.have.auxiliary import DeepMDP
from sb3_have.have.have import HAVESAC
from sb3_have.have.policies import MultiModalPolicy

FORMAT_VERSION = 1
# Base classes of the policies that can be exported; HAVESAC's is a SACPolicy
FAMILIES = (sac.SACPolicy, tqc.TQCPolicy, CrossQPolicy)
# The classes that a file may name
CLASSES: dict[str, type[Any]] = {
    f"{package}.{kind.__name__}": kind
    for package, kinds in {
        "sb3_have": (MultiModalPolicy, DeepMDP, Transfuser, CrossModalChannelAttention),
        "sb3_have.encoders": (ImageEncoder, VectorEncoder, MultiModalExtractor),
        "sb3_have.crossq": (crossq.MultiInputPolicy, crossq.MultiModalCrossQPolicy),
        "sb3_have.tqc": (MultiModalTQCPolicy,),
        "sb3_contrib.crossq": (CrossQPolicy,),
        "sb3_contrib.tqc": (tqc.TQCPolicy, tqc.CnnPolicy, tqc.MultiInputPolicy),
        "stable_baselines3.sac": (sac.SACPolicy, sac.CnnPolicy, sac.MultiInputPolicy),
        "stable_baselines3": (CombinedExtractor, FlattenExtractor, NatureCNN),
        "torch.nn": (
            nn.Identity,
            nn.ReLU,
            nn.Tanh,
            nn.ELU,
            nn.GELU,
            nn.SiLU,
            nn.Mish,
            nn.LeakyReLU,
            nn.Softplus,
            nn.Sigmoid,
        ),
        "torch.optim": (optim.Adam, optim.AdamW, optim.Adamax, optim.NAdam, optim.RAdam, optim.RMSprop, optim.SGD),
    }.items()
    for kind in kinds
}
NAMES = {kind: name for name, kind in CLASSES.items()}
# Maximum number of elements in a space, to limit the memory that a file can request; a 4K image has 2.5e7
MAX_SIZE = 10**8
PACKAGES = ("sb3_have", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy")
NORMALIZED = "the exported policy expects normalized observations but does not include the statistics"


def policy_of(model: BaseAlgorithm | BasePolicy) -> BasePolicy:
    """
    Return the policy of a model if it can be exported.

    :param model: A model or its policy
    """
    policy = getattr(model, "policy", model)
    if not isinstance(policy, FAMILIES):
        raise ValueError(f"expected a model or policy of HAVESAC, SAC, TQC or CrossQ, got {type(policy).__name__}")
    return policy


def describe(model: BaseAlgorithm | BasePolicy) -> dict[str, Any]:
    """
    Describe a policy in JSON types, and warn if it was trained under ``VecNormalize``.

    :param model: A model, or its policy, which stores neither the algorithm nor the frame stack
    """
    policy = policy_of(model)
    kwargs = policy._get_constructor_parameters()
    for name in ("observation_space", "action_space", "lr_schedule"):
        kwargs.pop(name, None)
    if not isinstance(policy, MultiModalPolicy):
        kwargs["share_features_extractor"] = policy.share_features_extractor  # SB3 leaves it out
    vec_normalize = model.get_vec_normalize_env() if isinstance(model, BaseAlgorithm) else None
    if vec_normalize is not None and vec_normalize.norm_obs:
        warnings.warn(f"{NORMALIZED}; save them with `model.get_vec_normalize_env().save(path)`", stacklevel=3)
    return {
        "format_version": FORMAT_VERSION,
        "algorithm": type(model).__name__ if isinstance(model, BaseAlgorithm) else None,
        "policy_class": _to_json(type(policy)),
        "policy_kwargs": _to_json(kwargs),
        "observation_space": _space_to_json(policy.observation_space),
        "action_space": _space_to_json(policy.action_space),
        "n_stack": _n_stack(model),
        "versions": {name: version(name) for name in PACKAGES},
    }


def build(
    config: Mapping[str, Any],
    size: int,
    policy_class: type[BasePolicy] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
) -> BasePolicy:
    """
    Build a policy with new weights from its configuration.

    :param config: The output of :func:`describe`
    :param size: Size of the saved weights, counting tensors and the numbers in them. The constructor may create
        parameters of twice that size, because it may replace some of its modules.
    :param policy_class: Replaces the class in the configuration
    :param policy_kwargs: Replace arguments in the configuration
    """
    found = config["format_version"]
    if type(found) is not int or found != FORMAT_VERSION:
        raise ValueError(f"format_version {found!r}, expected {FORMAT_VERSION}: upgrade sb3_have")
    kind = policy_class or _from_json(config["policy_class"], "policy_class")
    kwargs = dict(policy_kwargs or {})
    for name, value in config["policy_kwargs"].items():
        if name not in kwargs:
            kwargs[name] = _from_json(value, f"policy_kwargs[{name!r}]")
    observation_space = _space_from_json(config["observation_space"], "observation_space")
    action_space = _space_from_json(config["action_space"], "action_space")
    if not isinstance(action_space, spaces.Box):
        raise ValueError(f"action_space is damaged: expected a Box, got {action_space}")

    # The arguments must not exhaust the memory: count parameters before their values are initialized
    left = 2 * size

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal left
        if parameter is not None:
            left -= 1 + (0 if is_lazy(parameter) else parameter.numel())
        if left < 0:
            raise ValueError("the policy has more than twice the parameters that were saved")

    with register_module_parameter_registration_hook(count):
        return policy_of(kind(observation_space, action_space, ConstantSchedule(0.0), **kwargs))


def _n_stack(model: BaseAlgorithm | BasePolicy) -> int | None:
    """Return the number of frames that ``VecFrameStack`` stacked in training, or None if it is unknown."""
    if isinstance(model, HAVESAC):
        return model.n_stack
    env = model.get_env() if isinstance(model, BaseAlgorithm) else None
    stacked: int | None = getattr(model, "replay_buffer_kwargs", {}).get("n_stack")
    return stacked if env is None else stacked_frames(env)


def _to_json(value: Any) -> Any:
    """Convert to JSON types: classes become ``{"$class": name}``, other objects ``{"$object": type}``."""
    if isinstance(value, float) and not math.isfinite(value):
        return {"$float": str(value)}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return [_to_json(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _to_json(item) for key, item in value.items()}
    if isinstance(value, type):
        return {"$class": NAMES.get(value, value.__qualname__)}
    return {"$object": type(value).__qualname__}


def _from_json(value: Any, place: str) -> Any:
    """Reverse :func:`_to_json`; ``place`` names the value in the error."""
    if isinstance(value, list):
        return [_from_json(item, f"{place}[{i}]") for i, item in enumerate(value)]
    if not isinstance(value, dict):
        return value
    if value.get("$float") in ("inf", "-inf", "nan"):
        return float(value["$float"])
    if not value.keys() & {"$class", "$object", "$float"}:
        return {key: _from_json(item, f"{place}[{key!r}]") for key, item in value.items()}
    if value.get("$class") not in CLASSES:
        raise ValueError(
            f"{place} is {value}, which a file cannot provide: pass it to load_policy() as `policy_class` or in "
            "`policy_kwargs`"
        )
    return CLASSES[value["$class"]]


def _space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """Convert to JSON types: equal bounds become a single number, infinite ones "inf" and "-inf"."""
    if isinstance(space, spaces.Dict):
        return {"type": "Dict", "spaces": [[key, _space_to_json(item)] for key, item in space.spaces.items()]}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start), "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiDiscrete):
        choices = {"nvec": space.nvec.tolist(), "start": space.start.tolist()}
        return {"type": "MultiDiscrete", **choices, "dtype": str(space.dtype)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "n": space.n if isinstance(space.n, int) else list(space.n)}
    if not isinstance(space, spaces.Box):
        raise ValueError(f"expected a Box, Discrete, MultiDiscrete, MultiBinary or a Dict of them, got {space}")
    bounds = {}
    for name, bound in (("low", space.low), ("high", space.high)):
        same = bound.size > 0 and (bound == bound.flat[0]).all()
        values = np.asarray(bound.flat[0] if same else bound)
        bounds[name] = np.where(np.isfinite(values), values.astype(object), values.astype(str)).tolist()
    return {"type": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}


def _space_from_json(value: Any, place: str) -> spaces.Space[Any]:
    """Reverse :func:`_space_to_json`; ``place`` names the space in the error."""
    try:
        parts = value["spaces"] if value["type"] == "Dict" else [["", value]]
        if sum(math.prod(map(abs, part.get("shape", ()))) for _, part in parts) > MAX_SIZE:
            raise ValueError(f"more than {MAX_SIZE} numbers")
        # Gymnasium sorts the keys of a plain dict
        found: dict[str, spaces.Space[Any]] = OrderedDict((str(key), _part_from_json(part)) for key, part in parts)
        if sum(get_flattened_obs_dim(part) for part in found.values()) > MAX_SIZE:
            raise ValueError(f"more than {MAX_SIZE} numbers")
    except Exception as error:  # whatever a damaged file leads to
        raise ValueError(f"{place} is damaged: {error}") from error
    return spaces.Dict(found) if value["type"] == "Dict" else found[""]


def _part_from_json(value: Any) -> spaces.Space[Any]:
    match value["type"]:
        case "Discrete":
            return spaces.Discrete(value["n"], start=value["start"], dtype=_number(value["dtype"]))
        case "MultiDiscrete":
            return spaces.MultiDiscrete(value["nvec"], dtype=_number(value["dtype"]), start=value["start"])
        case "MultiBinary":
            return spaces.MultiBinary(value["n"])
        case "Box":
            return _box_from_json(value)
        case kind:
            raise ValueError(f"unknown space {kind}")


def _number(name: str) -> Any:
    """Return the type of a number by its name."""
    dtype = np.dtype(name)
    if dtype.kind not in "biuf" or dtype.itemsize > 8:
        raise ValueError(f"expected numbers, got dtype {name}")
    return dtype.type


def _box_from_json(value: Any) -> spaces.Box:
    dtype = _number(value["dtype"])
    low, high = (np.broadcast_to(np.asarray(value[name], dtype), value["shape"]) for name in ("low", "high"))
    return spaces.Box(low, high, dtype=dtype)
