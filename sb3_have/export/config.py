"""
A policy as JSON: spaces, arguments of its constructor, and classes by names of a closed list.

Reading it imports nothing by name: a class that is not in :data:`CLASSES` is the reader's to give.
"""

from __future__ import annotations

import math
import platform
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.crossq.policies import CrossQPolicy
from sb3_contrib.tqc import policies as tqc
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from stable_baselines3.sac import policies as sac
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.nn.parameter import is_lazy

from sb3_have.common import crossq, encoders, fusion
from sb3_have.common.buffers import stacked_frames
from sb3_have.common.tqc import MultiModalTQCPolicy
from sb3_have.have.deepmdp import DeepMDP
from sb3_have.have.have import HAVESAC
from sb3_have.have.policies import MultiModalPolicy

FORMAT_VERSION = 1
FAMILIES = (sac.SACPolicy, tqc.TQCPolicy, CrossQPolicy)
"""Bases of the policies that are exported; HAVESAC's is a SACPolicy."""
ACTIVATIONS = ("ReLU", "Tanh", "ELU", "GELU", "SiLU", "Mish", "LeakyReLU", "Softplus", "Sigmoid", "Identity")
OPTIMIZERS = ("Adam", "AdamW", "Adamax", "NAdam", "RAdam", "RMSprop", "SGD")
CLASSES: dict[str, type[Any]] = {
    "sb3_have.MultiModalPolicy": MultiModalPolicy,
    "sb3_have.common.crossq.MultiInputPolicy": crossq.MultiInputPolicy,
    "sb3_have.common.crossq.MultiModalCrossQPolicy": crossq.MultiModalCrossQPolicy,
    "sb3_have.common.tqc.MultiModalTQCPolicy": MultiModalTQCPolicy,
    "sb3_contrib.crossq.policies.CrossQPolicy": CrossQPolicy,
    **{
        f"sb3_contrib.tqc.policies.{name}": getattr(tqc, name)
        for name in ("TQCPolicy", "CnnPolicy", "MultiInputPolicy")
    },
    **{
        f"stable_baselines3.sac.policies.{name}": getattr(sac, name)
        for name in ("SACPolicy", "CnnPolicy", "MultiInputPolicy")
    },
    "sb3_have.have.DeepMDP": DeepMDP,
    **{
        f"sb3_have.common.encoders.{name}": getattr(encoders, name)
        for name in ("ImageEncoder", "VectorEncoder", "MultiModalExtractor")
    },
    **{
        f"sb3_have.common.fusion.{name}": getattr(fusion, name) for name in ("Transfuser", "CrossModalChannelAttention")
    },
    **{
        f"stable_baselines3.common.torch_layers.{kind.__name__}": kind
        for kind in (CombinedExtractor, FlattenExtractor, NatureCNN)
    },
    **{f"torch.nn.{name}": getattr(nn, name) for name in ACTIVATIONS},
    **{f"torch.optim.{name}": getattr(th.optim, name) for name in OPTIMIZERS},
}
"""The classes that a file may name."""
NAMES = {kind: name for name, kind in CLASSES.items()}
NON_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
DTYPES = ("float16", "float32", "float64", "uint8", "uint16", "uint32", "int8", "int16", "int32", "int64")
MAX_SIZE = 10**8
"""Values of a space, so that a file does not take all memory by its shapes; an image of 4K has 2.5e7."""
NORMALIZED = "what is exported takes normalized observations, and the statistics are not in it"
_ABSENT = object()


def policy_of(model: BaseAlgorithm | BasePolicy) -> BasePolicy:
    """
    :param model: a model, or its policy
    :raises ValueError: if it is not of an algorithm whose policy can be exported
    """
    policy = model if isinstance(model, BasePolicy) else getattr(model, "policy", None)
    if not isinstance(policy, FAMILIES):
        raise ValueError(
            f"expected a model or policy of HAVESAC, SAC, TQC or MultiInputCrossQ, got {type(model).__name__}."
        )
    return policy


def describe(model: BaseAlgorithm | BasePolicy) -> dict[str, Any]:
    """
    The configuration of a policy, in JSON's types.

    :param model: a model, or its policy alone, of which algorithm and frame stack are not known
    :raises ValueError: for spaces other than Box and a Dict of Boxes
    """
    policy = policy_of(model)
    kwargs = policy._get_constructor_parameters()
    for name in ("observation_space", "action_space", "lr_schedule"):
        kwargs.pop(name, None)
    if not isinstance(policy, MultiModalPolicy):
        kwargs["share_features_extractor"] = policy.share_features_extractor  # SB3 leaves it out
    return {
        "format_version": FORMAT_VERSION,
        "algorithm": None if model is policy else type(model).__name__,
        "policy_class": to_json(type(policy)),
        "policy_kwargs": to_json(kwargs),
        "observation_space": space_to_json(policy.observation_space),
        "action_space": space_to_json(policy.action_space),
        "n_stack": n_stack(model),
        "versions": versions(),
    }


def n_stack(model: BaseAlgorithm | BasePolicy) -> int | None:
    """The frames that VecFrameStack stacked in training, None where it cannot be known."""
    if not isinstance(model, BaseAlgorithm):
        return None
    if isinstance(model, HAVESAC):
        return model.n_stack
    if (env := model.get_env()) is not None:
        return stacked_frames(env)
    given = getattr(model, "replay_buffer_kwargs", {}).get("n_stack")
    return None if given is None else int(given)


def warn_of_normalization(model: BaseAlgorithm | BasePolicy) -> None:
    """A warning if VecNormalize stands between the environment and the policy, since its statistics stay behind."""
    vec_normalize = model.get_vec_normalize_env() if isinstance(model, BaseAlgorithm) else None
    if vec_normalize is not None and vec_normalize.norm_obs:
        warnings.warn(
            f"the model was trained under VecNormalize: {NORMALIZED}; save them with "
            "`model.get_vec_normalize_env().save(path)`.",
            stacklevel=3,
        )


def versions() -> dict[str, str]:
    """Versions of Python and the packages that a policy depends on."""
    found = {"python": platform.python_version()}
    for name in ("sb3_have", "torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # a source tree that is not installed
            continue
    return found


def build(
    config: Mapping[str, Any],
    path: Path,
    size: int,
    policy_class: type[BasePolicy] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
) -> BasePolicy:
    """
    A policy with new weights, by its configuration.

    :param config: as :func:`describe` gives it
    :param path: its file, for the messages
    :param size: numbers and tensors of its weights, of which its parameters may have twice as many
    :param policy_class: in place of the configuration's
    :param policy_kwargs: likewise, merged into the configuration's key by key
    :raises ValueError: if the configuration is damaged, of a newer format, or lacks classes; names file and remedy
    """
    _check_format(config, path)
    kind = policy_class
    if kind is None:
        kind = from_json(config["policy_class"], _ABSENT, path, "policy_class", ())
    if not (isinstance(kind, type) and issubclass(kind, FAMILIES)):
        raise ValueError(
            f"{path}: policy_class is {kind!r}, expected a policy of {[base.__name__ for base in FAMILIES]}."
        )
    try:
        kwargs = from_json(config["policy_kwargs"], policy_kwargs or {}, path, "policy_kwargs", ())
        observation_space = space_from_json(config["observation_space"], path, "observation_space")
        action_space = space_from_json(config["action_space"], path, "action_space")
    except RecursionError as error:
        raise ValueError(f"{path}: nested too deep; export the policy again.") from error
    try:
        with _at_most(2 * size):  # twice, as a constructor may replace what it made
            policy: BasePolicy = kind(observation_space, action_space, _no_schedule, **kwargs)  # type: ignore[arg-type]
    except Exception as error:  # whatever a damaged file makes of the arguments
        raise ValueError(
            f"{path}: {kind.__name__} cannot be built of it: {type(error).__name__}: {error} Export it again, or mend "
            "it by `policy_class` and `policy_kwargs`."
        ) from error
    return policy


@contextmanager
def _at_most(size: int) -> Iterator[None]:
    """ValueError in here as soon as parameters have more numbers, so that a file takes no memory by its arguments."""
    left = size

    def count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
        nonlocal left
        # a lazy one has no shape yet; it is of a class that the caller gave
        left -= 0 if parameter is None else 1 + (0 if is_lazy(parameter) else parameter.numel())
        if left < 0:
            raise ValueError("its parameters are more than twice those of the weights.")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def _no_schedule(progress_remaining: float) -> float:
    return 0.0


def _check_format(config: Any, path: Path) -> None:
    expected = {"format_version": int, "policy_class": dict, "policy_kwargs": dict}
    expected |= {"observation_space": dict, "action_space": dict}
    if not isinstance(config, dict):
        raise ValueError(f"{path}: expected a JSON object, got {type(config).__name__}; export the policy again.")
    found = config.get("format_version")
    if type(found) is int and found > FORMAT_VERSION:
        written = config.get("versions")
        by = written.get("sb3_have") if isinstance(written, dict) else None
        raise ValueError(
            f"{path}: format_version {found}, written by sb3_have {by or 'of a later version'}; this one reads up to "
            f"{FORMAT_VERSION}: upgrade sb3_have."
        )
    for name, kind in expected.items():
        if type(config.get(name)) is not kind:
            raise ValueError(
                f"{path}: {name!r} is {config.get(name)!r}, expected {kind.__name__}; it is not the config.json of "
                "export_safetensors, or damaged: export the policy again."
            )


def to_json(value: Any) -> Any:
    """
    ``value`` in JSON's types: tuples become lists, classes ``{"$class": name}``, numbers that are not finite
    ``{"$float": "inf"}``, and what a file may not name ``{"$given": what it was}``, to be given by who reads it.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else {"$float": str(float(value))}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) and not key.startswith("$") for key in value):
        return {key: to_json(item) for key, item in value.items()}
    if isinstance(value, type):
        name = NAMES.get(value)
        return {"$given": f"class {value.__qualname__}"} if name is None else {"$class": name}
    return {"$given": f"an object of class {type(value).__qualname__}"}


def from_json(value: Any, given: Any, path: Path, argument: str, keys: tuple[str, ...]) -> Any:
    """
    The reverse of :func:`to_json`.

    :param value: of JSON
    :param given: by who reads it: a value in its place, or a mapping with some values of a mapping
    :param path: of the file, for the messages
    :param argument: of :func:`~sb3_have.export.load_policy` that would give it
    :param keys: under which it stands there
    :raises ValueError: if something has to be given and is not
    """
    marker = next((key for key in value if key.startswith("$")), None) if isinstance(value, dict) else None
    if given is not _ABSENT and (marker or not (isinstance(value, dict) and isinstance(given, Mapping))):
        return given
    if isinstance(value, list):
        return [from_json(item, _ABSENT, path, argument, keys) for item in value]
    if not isinstance(value, dict):
        return value
    if marker is None:
        own = given if isinstance(given, Mapping) else {}
        read = {
            key: from_json(item, own.get(key, _ABSENT), path, argument, (*keys, key)) for key, item in value.items()
        }
        return {**read, **{key: item for key, item in own.items() if key not in read}}
    content = value[marker]
    if marker == "$class" and isinstance(content, str) and content in CLASSES:
        return CLASSES[content]
    if marker == "$float" and isinstance(content, str) and content in NON_FINITE:
        return NON_FINITE[content]
    place = argument + "".join(f"[{key!r}]" for key in keys)
    remedy = "..."
    for key in reversed(keys):
        remedy = f"{{{key!r}: {remedy}}}"
    raise ValueError(
        f"{path}: {place} is {content!r}, which is not among the classes that a file may name; give it: "
        f"load_policy(path, {argument}={remedy})."
    )


def space_to_json(space: spaces.Space[Any]) -> dict[str, Any]:
    """A Box, or a Dict of Boxes in its order; bounds that are the same everywhere are one number.

    :raises ValueError: for other spaces
    """
    if isinstance(space, spaces.Dict) and not any(isinstance(item, spaces.Dict) for item in space.values()):
        return {"type": "Dict", "spaces": [[key, space_to_json(item)] for key, item in space.spaces.items()]}
    if not isinstance(space, spaces.Box) or str(space.dtype) not in DTYPES:
        raise ValueError(f"only Box spaces and Dicts of them are exported, got {space}.")
    bounds = {
        name: to_json(bound.flat[0] if bound.size and (bound == bound.flat[0]).all() else bound.tolist())
        for name, bound in (("low", space.low), ("high", space.high))
    }
    return {"type": "Box", "shape": list(space.shape), "dtype": str(space.dtype), **bounds}


def space_from_json(value: Any, path: Path, where: str) -> spaces.Space[Any]:
    """
    The reverse of :func:`space_to_json`.

    :raises ValueError: if there is no such space; names the file and where in it
    """
    try:
        if value["type"] == "Dict":
            if any(item["type"] != "Box" for _, item in value["spaces"]):
                raise ValueError("a Dict of something else than Boxes")
            if sum(_size(item["shape"]) for _, item in value["spaces"]) > MAX_SIZE:
                raise ValueError(f"its spaces have more than {MAX_SIZE} values")
            pairs = [(str(key), space_from_json(item, path, f"{where}[{key!r}]")) for key, item in value["spaces"]]
            return spaces.Dict(OrderedDict(pairs))
        if value["type"] != "Box" or value["dtype"] not in DTYPES:
            raise ValueError(f"type {value['type']!r} of dtype {value.get('dtype')!r}, expected a Box of a NumPy type")
        shape, dtype = tuple(value["shape"]), np.dtype(value["dtype"])
        if _size(shape) > MAX_SIZE:
            raise ValueError(f"shape {shape} has more than {MAX_SIZE} values")
        low, high = (np.asarray(from_json(value[name], _ABSENT, path, where, ()), dtype) for name in ("low", "high"))
        return spaces.Box(np.broadcast_to(low, shape), np.broadcast_to(high, shape), shape, dtype.type)
    except (AssertionError, AttributeError, KeyError, MemoryError, OverflowError, TypeError, ValueError) as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {where} is damaged: {error}; export the policy again.") from error


def _size(shape: Sequence[Any]) -> int:
    """
    :raises ValueError: if a dimension is not a whole number from 0 on
    """
    if not all(type(length) is int and length >= 0 for length in shape):
        raise ValueError(f"shape {shape}, expected whole numbers from 0 on")
    return math.prod(shape)
