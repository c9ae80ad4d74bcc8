"""
Configurations in the format of the RL Zoo: a YAML file with a block of hyper-parameters per environment.

Two more keys may stand beside the blocks, where the Zoo does not look::

    algo: havesac           # name in sb3_have.algorithms; default: that of the base, else havesac
    base: have              # another configuration, whose blocks this file's are merged into

    HighwayVision-v0:
      modality_dropout: 0.2

A file covers the environments for which it has a block, which may be ``{}``. Its hyper-parameters replace those of the
base, except that ``env_kwargs`` are merged. Hyper-parameters of the base that the algorithm lacks are left out, such as
``tau`` for CrossQ.

All keys of the Zoo have the same meaning here, for which rl_zoo3 need not be installed. That includes Python code in
strings (``policy_kwargs: "dict(activation_fn=nn.Tanh)"``), so only read files that you trust.
"""

from __future__ import annotations

import argparse
import inspect
import re
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_have.algorithms import ALGORITHMS

Env = gym.Env[Any, Any]

# Keys that do not go to the algorithm's constructor
ZOO_KEYS = (
    "n_timesteps", "n_envs", "env_kwargs", "env_wrapper", "monitor_kwargs", "vec_env_wrapper", "normalize",
    "frame_stack", "callback", "noise_type", "noise_std",
)  # fmt: skip

# Keys whose value is the dotted path of a class or something else
CLASS_OR_WORD = ("policy", "activation_fn", "fusion", "auxiliary")

# Keys whose value may be Python code
PYTHON = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs")

DOTTED_PATH = re.compile(r"\w+(\.\w+)+")

# What Python code may use, as in the Zoo
NAMESPACE = {"th": th, "nn": th.nn, "np": np, "HerReplayBuffer": HerReplayBuffer, "RMSpropTFLike": RMSpropTFLike}

# Counts, which may be written as 1e6
INTEGERS = ("buffer_size", "learning_starts", "batch_size", "train_freq", "gradient_steps")


def config_path(name: str | Path) -> Path:
    """
    Find the file of a configuration.

    :param name: Path of a file, or name of a configuration in ``zoo_configs`` ("have")
    :raises FileNotFoundError: If there is neither
    """
    for path in (Path(name), config_folder() / f"{name}.yml"):
        if path.is_file():
            return path
    raise FileNotFoundError(f"there is no configuration {str(name)!r}{suggest(str(name), config_names())}")


def config_names() -> list[str]:
    """Return the names of the configurations in ``zoo_configs``, sorted."""
    return sorted(path.stem for path in config_folder().glob("*.yml") if path.stem != "shared")


def config_folder() -> Path:
    """Return the folder of the configurations that come with the package."""
    # zoo_configs lies inside the package in a wheel and beside it in a checkout
    inside = Path(__file__).parent / "zoo_configs"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "zoo_configs"


def suggest(word: str, known: Iterable[str]) -> str:
    """Return the end of an error about an unknown word: the known one that was probably meant, and all of them."""
    near = get_close_matches(word, list(known), n=1, cutoff=0.75)
    available = ", ".join(sorted(known))
    return f"; did you mean {near[0]!r}? Available: {available}" if near else f"; available: {available}"


def read_config(name: str | Path) -> dict[str, Any]:
    """
    Read a whole file, without its base.

    :raises ValueError: If it is not a mapping
    """
    path = config_path(name)
    with path.open() as file:
        content = yaml.safe_load(file)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected environment ids, each with a block of hyper-parameters, got {content!r}")
    return content


def load_config(name: str | Path, env_id: str) -> dict[str, Any]:
    """
    Read the hyper-parameters for an environment.

    :param name: See :func:`config_path`
    :param env_id: Environment id; a module prefix ("my_package:MyEnv-v0") may be missing in the file
    :raises KeyError: If the file has no block for the environment
    """
    content = read_config(name)
    block = content.get(env_id, content.get(env_id.rpartition(":")[2]))
    if not isinstance(block, dict):
        env_ids = [key for key, value in content.items() if isinstance(value, dict)]
        raise KeyError(f"{config_path(name)} has no block for {env_id!r}, only for {', '.join(env_ids)}")
    if "base" not in content:
        return block

    # Merge the block into that of the base, without what only other algorithms have
    others = set().union(*map(known_keys, ALGORITHMS)) - known_keys(algorithm_of(name))
    base = {key: value for key, value in load_config(_base(name, content), env_id).items() if key not in others}
    merged = {**base, **block}
    if "env_kwargs" in base and "env_kwargs" in block:
        merged["env_kwargs"] = {**base["env_kwargs"], **block["env_kwargs"]}
    return merged


def algorithm_of(name: str | Path) -> str:
    """
    Return the name of the algorithm that a configuration is for.

    :param name: See :func:`config_path`
    :raises ValueError: If there is no such algorithm
    """
    content = read_config(name)
    if "algo" not in content and "base" in content:
        return algorithm_of(_base(name, content))
    algo = str(content.get("algo", "havesac"))
    if algo not in ALGORITHMS:
        raise ValueError(f"{config_path(name)}: there is no algo {algo!r}{suggest(algo, ALGORITHMS)}")
    return algo


def _base(name: str | Path, content: Mapping[str, Any]) -> str | Path:
    """Return the base: a file beside the one that names it, or a name in ``zoo_configs``."""
    beside = config_path(name).parent / content["base"]
    return beside if beside.is_file() else str(content["base"])


def known_keys(algo: str) -> set[str]:
    """Return the keys that a configuration for an algorithm may have."""
    set_by_the_run = {"env", "seed", "device", "_init_setup_model"}
    return {*ZOO_KEYS, *inspect.signature(ALGORITHMS[algo]).parameters} - set_by_the_run


def check_keys(config: Mapping[str, Any], algo: str) -> None:
    """
    Check that every key of a configuration is one of the Zoo's or a hyper-parameter of the algorithm.

    :raises ValueError: If one is not
    """
    known = known_keys(algo)
    if unknown := [key for key in config if key not in known]:
        raise ValueError(f"{algo} has no hyper-parameter {unknown[0]!r}{suggest(unknown[0], known)}")


def evaluation_env_kwargs(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``env_kwargs`` of a configuration without the weather, which :func:`sb3_have.evaluate` sets itself."""
    return {key: value for key, value in config.get("env_kwargs", {}).items() if key != "weather"}


def model_kwargs(config: Mapping[str, Any], env: VecEnv | None = None) -> dict[str, Any]:
    """
    Return the arguments of the algorithm's constructor.

    The strings of a configuration become objects: ``learning_rate: lin_1e-3`` a schedule that decays linearly from 1e-3
    to 0, ``noise_type`` an action noise, and dotted paths classes. The latter may stand under ``policy``,
    ``activation_fn``, ``fusion``, ``auxiliary`` and every key that ends in ``_class`` or ``_classes``::

        policy_kwargs:
          activation_fn: torch.nn.Tanh

    :param config: Hyper-parameters for an environment
    :param env: The environment, which is needed if the configuration has a ``noise_type``
    :raises ValueError: If a value cannot be read
    """
    kwargs = {key: _resolve(key, value) for key, value in config.items() if key not in ZOO_KEYS}
    if config.get("noise_type") is not None:
        assert env is not None, "noise_type needs the environment"
        kwargs["action_noise"] = _action_noise(config, env)
    return kwargs


def _resolve(key: str, value: Any) -> Any:
    """Return a copy, because SB3 writes into ``policy_kwargs``, with objects in place of strings."""
    is_class = key.endswith(("_class", "_classes"))
    if isinstance(value, Mapping):
        inherited = key if is_class or key in CLASS_OR_WORD else None
        return {name: _resolve(inherited or name, item) for name, item in value.items()}
    if isinstance(value, str):
        if key == "learning_rate":
            return _linear_schedule(value)
        if key in PYTHON and not DOTTED_PATH.fullmatch(value):
            return _python(key, value)
        if is_class or (key in CLASS_OR_WORD and "." in value):
            return _locate(value, key)
    if key in INTEGERS and isinstance(value, float) and value.is_integer():
        return int(value)
    if key == "train_freq" and isinstance(value, list):
        return tuple(value)
    return deepcopy(value)


def _python(key: str, code: Any) -> Any:
    """Evaluate Python code in a string, as the Zoo does; return everything else as it is."""
    if not isinstance(code, str):
        return code
    try:
        return eval(code, dict(NAMESPACE))
    except Exception as error:
        raise ValueError(f"{key}: {code!r} is not Python: {error!r}") from error


def _linear_schedule(text: str) -> LinearSchedule:
    """Return the schedule of ``lin_<initial value>``."""
    name, _, initial_value = text.partition("_")
    try:
        if name != "lin":
            raise ValueError(text)
        return LinearSchedule(float(initial_value), end=0.0, end_fraction=1.0)
    except ValueError:
        raise ValueError(
            f"learning_rate={text!r}: expected a number, or a linear schedule such as 'lin_1e-3'"
        ) from None


def _action_noise(config: Mapping[str, Any], env: VecEnv) -> ActionNoise:
    (n_actions,) = env.action_space.shape or ()
    mean, sigma = np.zeros(n_actions), float(config["noise_std"]) * np.ones(n_actions)
    if config["noise_type"] == "normal":
        return NormalActionNoise(mean, sigma)
    if config["noise_type"] == "ornstein-uhlenbeck":
        return OrnsteinUhlenbeckActionNoise(mean, sigma)
    raise ValueError(f"noise_type={config['noise_type']!r}: expected 'normal' or 'ornstein-uhlenbeck'")


def monitor_kwargs(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of SB3's ``Monitor``."""
    return dict(_python("monitor_kwargs", config.get("monitor_kwargs")) or {})


def normalize_kwargs(config: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the arguments of ``VecNormalize``, or None if the configuration does not normalize."""
    normalize = _python("normalize", config.get("normalize"))
    if not normalize:
        return None
    # Use the discount factor of the algorithm
    gamma = {"gamma": config["gamma"]} if "gamma" in config else {}
    return {**(normalize if isinstance(normalize, Mapping) else {}), **gamma}


def env_wrapper(config: Mapping[str, Any]) -> Callable[[Env], Env] | None:
    """
    Return the ``env_wrapper`` of a configuration as one function, or None.

    As in the Zoo it is a dotted path, a mapping of a dotted path to keywords, or a list of these, innermost first::

        env_wrapper:
          - sb3_have.sensors.SensorFailure:
              modality: rgb
              kind: black
              probability: 0.1
              per: episode
          - gymnasium.wrappers.RecordEpisodeStatistics

    :return: Can be pickled, so that it reaches the workers of ``SubprocVecEnv``
    :raises ValueError: If an entry is malformed or cannot be imported
    """
    wrappers = _entries(config, "env_wrapper")
    return partial(_wrap, wrappers) if wrappers else None


def wrap_vec_env(config: Mapping[str, Any], vec_env: VecEnv) -> VecEnv:
    """Wrap an environment in the ``vec_env_wrapper`` of a configuration, which has the form of ``env_wrapper``."""
    wrapped: VecEnv = _wrap(_entries(config, "vec_env_wrapper"), vec_env)
    return wrapped


def make_callbacks(config: Mapping[str, Any]) -> list[BaseCallback]:
    """Return the ``callback`` of a configuration, which has the form of ``env_wrapper``."""
    return [callback(**kwargs) for callback, kwargs in _entries(config, "callback")]


def _entries(config: Mapping[str, Any], key: str) -> list[tuple[Callable[..., Any], dict[str, Any]]]:
    """Return the classes under a key with their keywords."""
    given = config.get(key)
    entries = []
    for entry in given if isinstance(given, list) else [] if given is None else [given]:
        # "module.Class: {keyword: value}" may be quoted
        read = yaml.safe_load(entry) if isinstance(entry, str) else entry
        path, kwargs = next(iter(read.items())) if isinstance(read, Mapping) and len(read) == 1 else (read, None)
        if not isinstance(path, str) or not isinstance(kwargs, Mapping | None):
            raise ValueError(f"{key}: expected 'module.Class' or 'module.Class: {{keyword: value}}', got {entry!r}")
        entries.append((_locate(path, key), dict(kwargs or {})))
    return entries


def _wrap(wrappers: list[tuple[Callable[..., Any], dict[str, Any]]], env: Any) -> Any:
    for wrapper, kwargs in wrappers:
        env = wrapper(env, **kwargs)
    return env


def _locate(path: str, key: str) -> Any:
    """Import the object at a dotted path."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{key}: cannot import {path!r}: {error}") from error


def hyperparameter(text: str) -> tuple[str, Any]:
    """
    Parse ``name:value`` of a command line. The value is YAML, except that 1e-3 and 1e6, which YAML takes for words, are
    a float and an int.
    """
    name, separator, value = text.partition(":")
    if not separator:
        raise argparse.ArgumentTypeError(f"expected NAME:VALUE, got {text!r}")
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"the value in {text!r} is not YAML: {error}") from error
    try:
        number = float(parsed if isinstance(parsed, str) else "no number")
    except ValueError:
        return name, parsed
    return name, int(number) if number.is_integer() else number


def main(arguments: list[str] | None = None) -> None:
    """Print a configuration merged with its base, as one file for the RL Zoo."""
    parser = argparse.ArgumentParser(prog="python -m sb3_have.configuration", description=main.__doc__)
    parser.add_argument("name", help="YAML file, or the name of one in zoo_configs")
    name = parser.parse_args(arguments).name
    blocks = {key: load_config(name, key) for key, block in read_config(name).items() if isinstance(block, dict)}
    print(yaml.safe_dump({"algo": algorithm_of(name), **blocks}, sort_keys=False))


if __name__ == "__main__":
    main()
