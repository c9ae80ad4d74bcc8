"""Configurations in the format of the RL Zoo: a YAML file with a block of hyper-parameters per environment."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.utils import LinearSchedule

Env = gym.Env[Any, Any]
CLASS_OR_WORD = ("policy", "activation_fn", "fusion", "auxiliary")
"""Keys whose value names a class by its dotted path, or something else by a word."""


def config_path(name: str) -> Path:
    """File of a configuration.

    :param name: of a file, or of one in ``zoo_configs`` without its ending ("havesac")
    :raises FileNotFoundError: if there is neither
    """
    package = Path(__file__).parent
    # zoo_configs lies inside the package in a wheel and beside it in a checkout
    candidates = [Path(name), package / "zoo_configs" / f"{name}.yml", package.parent / "zoo_configs" / f"{name}.yml"]
    for path in candidates:
        if path.is_file():
            return path
    raise FileNotFoundError(f"no configuration {name!r}; looked for {', '.join(map(str, candidates))}")


def config_names() -> list[str]:
    """Names of the configurations in ``zoo_configs``, in order."""
    return sorted(path.stem for path in config_path("havesac").parent.glob("*.yml"))


def read_blocks(path: str | Path) -> dict[str, dict[str, Any]]:
    """The blocks of a file, by environment id.

    :raises ValueError: if it is not YAML, or of another form
    """
    try:
        blocks = yaml.safe_load(Path(path).read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not YAML: {error}") from error
    if not isinstance(blocks, dict) or not all(isinstance(block, dict) for block in blocks.values()):
        raise ValueError(
            f"{path}: expected ids of environments, and under each a block of `name: value`, as zoo_configs has them"
        )
    return blocks


def load_config(name: str, env_id: str) -> dict[str, Any]:
    """Hyper-parameters for an environment.

    :param name: see :func:`config_path`
    :param env_id: key of the block to read
    :raises KeyError: if the file has no block for it
    :raises ValueError: if it cannot be read
    """
    path = config_path(name)
    blocks = read_blocks(path)
    if env_id not in blocks:
        raise KeyError(f"{path} has no block for {env_id!r}, only for {', '.join(blocks)}")
    return dict(blocks[env_id])


def evaluation_env_kwargs(config: Mapping[str, Any]) -> dict[str, Any]:
    """The ``env_kwargs`` of a configuration without the weather, which :func:`sb3_have.evaluate` sets itself."""
    return {key: value for key, value in config.get("env_kwargs", {}).items() if key != "weather"}


def model_kwargs(config: Mapping[str, Any]) -> dict[str, Any]:
    """What of a configuration goes to the algorithm's constructor.

    Dotted paths become what they name under every key that ends in ``_class`` or ``_classes``, and under ``policy``,
    ``activation_fn``, ``fusion`` and ``auxiliary``, which may be words too::

        policy_kwargs:
          features_extractor_class: sb3_have.common.encoders.MultiModalExtractor
          activation_fn: torch.nn.Tanh

    The Zoo does so for ``policy`` alone; in its own format the rest is Python in a string, which it evaluates without
    knowing this package. :mod:`sb3_have.zoo` translates.

    ``learning_rate: lin_1e-3`` is the Zoo's schedule: it decays linearly from 1e-3 to 0 over the training.

    :raises ValueError: if a path leads nowhere, or ``learning_rate`` is a word of another form
    """
    for_others = {"n_timesteps", "n_envs", "frame_stack", "env_kwargs", "env_wrapper"}
    return {key: _resolve(key, value) for key, value in config.items() if key not in for_others}


def _resolve(key: str, value: Any) -> Any:
    """A copy, because SB3 writes into policy_kwargs, with classes for their paths."""
    is_class = key.endswith(("_class", "_classes"))
    if isinstance(value, Mapping):
        inherited = key if is_class or key in CLASS_OR_WORD else None
        return {name: _resolve(inherited or name, item) for name, item in value.items()}
    if key == "learning_rate" and isinstance(value, str):
        return _linear_schedule(value)
    if isinstance(value, str) and (is_class or (key in CLASS_OR_WORD and "." in value)):
        return _locate(value, key)
    return deepcopy(value)


def _linear_schedule(text: str) -> LinearSchedule:
    """The schedule of ``lin_<initial value>``."""
    name, _, initial_value = text.partition("_")
    try:
        if name != "lin":
            raise ValueError(text)
        return LinearSchedule(float(initial_value), end=0.0, end_fraction=1.0)
    except ValueError:
        raise ValueError(
            f"learning_rate={text!r}: expected a number, or a linear schedule such as 'lin_1e-3'"
        ) from None


def env_wrapper(config: Mapping[str, Any]) -> Callable[[Env], Env] | None:
    """The ``env_wrapper`` of a configuration as one function, or None.

    As in the Zoo it is a dotted path, a mapping of a dotted path to keywords, or a list of such, innermost first::

        env_wrapper:
          - sb3_have.sensors.SensorFailure:
              modality: rgb
              kind: black
              probability: 0.1
              per: episode
          - gymnasium.wrappers.RecordEpisodeStatistics

    :return: can be pickled, so that it reaches the workers of ``SubprocVecEnv``
    :raises ValueError: if an entry has another form or its path leads nowhere
    """
    given = config.get("env_wrapper")
    if given is None:
        return None
    wrappers = []
    for entry in given if isinstance(given, list) else [given]:
        if isinstance(entry, Mapping) and len(entry) == 1:
            path, kwargs = next(iter(entry.items()))
        else:
            path, kwargs = entry, None
        if not isinstance(path, str) or not isinstance(kwargs, Mapping | None):
            raise ValueError(f"an env_wrapper is 'module.Class' or 'module.Class: {{keyword: value}}', got {entry!r}")
        wrappers.append((_locate(path, "env_wrapper"), dict(kwargs or {})))
    return partial(_wrap, wrappers)


def _wrap(wrappers: list[tuple[Callable[..., Env], dict[str, Any]]], env: Env) -> Env:
    for wrapper, kwargs in wrappers:
        env = wrapper(env, **kwargs)
    return env


def _locate(path: str, key: str) -> Any:
    """What a dotted path names."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"there is no {key} {path!r}: {error}") from error


def hyperparameter(text: str) -> tuple[str, Any]:
    """
    Name and value of ``name:value``, the value in YAML, but for 1e-3 and 1e6, which are a float and an int here and in
    YAML words.
    """
    name, separator, value = text.partition(":")
    if not separator:
        raise argparse.ArgumentTypeError(f"expected NAME:VALUE, got {text!r}")
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not YAML behind the colon: {error}") from error
    try:
        number = float(parsed if isinstance(parsed, str) else "no word")
    except ValueError:
        return name, parsed
    return name, int(number) if number.is_integer() else number
