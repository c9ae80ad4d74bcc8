"""What a benchmark runs: methods and seeds, how long they train, and what they are asked afterwards.

A grid is a YAML file; only ``methods`` and ``seeds`` have to be there::

    env: HighwayVision-v0
    steps: 30000
    methods: [gve, lve, have]      # of zoo_configs, or files relative to the grid's; the name of a file is the method's
    seeds: [0, 1, 2]               # order of work: seed by seed over all methods
    weathers: [ClearNoon, ...]     # default: all eight
    hyperparams: {env_kwargs: {vehicles_count: 20}, batch_size: 64}
    modalities: [rgb, event]       # default: every method's own
    eval_freq: 5000                # steps between the points of the learning curve, 0 for none
    eval_episodes: 1               # of a point, in each weather
    final_episodes: 10             # after training, in each weather
    final_seed: 2000000            # of the first of those; a search takes others than the tables
    eval_envs: 16                  # environments of an evaluation at a time, in the run's process
    save_freq: 5000                # steps between checkpoints
    failures: {kinds: [black, frozen, noise], severity: 3, episodes: 1}   # after that; left out: none

``hyperparams`` stand in the place of every method's own. Of ``env_kwargs`` and ``policy_kwargs`` only given keys do:
``{env_kwargs: {image_size: 84}}`` leaves the rest as it was. In ``policy_kwargs`` a method's own keys stay, as they are
what makes it that method. For the same reason ``modalities`` is a key of its own and not of ``env_kwargs``: it gives
other sensors to every method that has several, and leaves ``rgb`` its one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_have.configuration import algorithm_of, config_names, config_path, known_keys, load_config
from sb3_have.envs.weather import WEATHERS
from sb3_have.sensors import SENSORS, failures_for

FINAL_SEED = 2_000_000
"""Seed of the first episode after training, the same for all methods and seeds. No run is trained on these episodes
or chosen by them (:data:`sb3_have.train.EVALUATION_SEED`)."""

OWN_ENVS = ("HighwayVision-v0", "CarlaVision-v0")


class GridError(ValueError):
    """A grid that cannot be run; the message names the key, its value and the remedy."""


@dataclass(frozen=True)
class Failures:
    """Sensors that fail for whole episodes after training.

    :param kinds: of failure, see :data:`sb3_have.sensors.failures.FAILURES`; each on every modality that knows it
    :param severity: 1, 2 or 3
    :param episodes: in each weather, the first of the final evaluation
    """

    kinds: tuple[str, ...]
    severity: int = 3
    episodes: int = 1


@dataclass(frozen=True)
class Grid:
    """Methods x seeds and what is done with each; the parameters are the keys of the file, see this module."""

    name: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    env: str = "HighwayVision-v0"
    steps: int = 30_000
    weathers: tuple[str, ...] = WEATHERS
    modalities: tuple[str, ...] = ()
    hyperparams: Mapping[str, Any] = field(default_factory=dict)
    eval_freq: int = 5_000
    eval_episodes: int = 1
    final_episodes: int = 10
    final_seed: int = FINAL_SEED
    eval_envs: int = 16
    save_freq: int = 5_000
    failures: Failures | None = None

    def jobs(self, only: Iterable[str] = ()) -> list[Job]:
        """The runs in the order of work.

        :param only: methods to keep, all if there are none
        :raises GridError: if one of ``only`` is not in the grid, or a method's configuration does not fit
        """
        names = [method_name(method) for method in self.methods]
        if unknown := [name for name in only if name not in names]:
            raise GridError(f"--only: {self.name} has no {unknown[0]!r}{_remedy(unknown[0], names)}")
        configs = {name: self._config(method) for name, method in zip(names, self.methods, strict=True)}
        kept = [name for name in names if not only or name in only]
        algos = {name: algorithm_of(method) for name, method in zip(names, self.methods, strict=True)}
        return [Job(self, name, seed, algos[name], configs[name]) for seed in self.seeds for name in kept]

    def _config(self, method: str) -> dict[str, Any]:
        try:
            own = load_config(method, self.env)
        except KeyError as error:
            raise GridError(f"methods: {error.args[0]}") from None
        config = merge(own, self.hyperparams)
        if self.modalities and len(config.get("env_kwargs", {}).get("modalities", self.modalities)) > 1:
            config["env_kwargs"] = {**config.get("env_kwargs", {}), "modalities": [*self.modalities]}
        name, algo = method_name(method), algorithm_of(method)
        known = known_keys(algo)
        if unknown := [key for key in config if key not in known]:
            raise GridError(f"hyperparams: {algo} (for {name}) knows no {unknown[0]!r}{_remedy(unknown[0], known)}")
        return config

    def overruled(self) -> list[str]:
        """Which of the grid's ``policy_kwargs`` do not reach methods because those have their own.

        :raises GridError: if one reaches none of them
        """
        told = []
        own = {method_name(m): load_config(m, self.env).get("policy_kwargs", {}) for m in self.methods}
        for key, value in self.hyperparams.get("policy_kwargs", {}).items():
            others = {name: mine[key] for name, mine in own.items() if mine.get(key, value) != value}
            if len(others) == len(own):
                raise GridError(
                    f"hyperparams: policy_kwargs.{key}: {value!r} reaches no method, all have their own; remove it"
                )
            told += [
                f"{name} keeps its own policy_kwargs.{key}: {other!r}, not {value!r}" for name, other in others.items()
            ]
        return told


@dataclass(frozen=True)
class Job:
    """One run of a grid.

    :param grid: to which it belongs
    :param method: its name
    :param seed: of the training
    :param algo: name in :data:`sb3_have.algorithms.ALGORITHMS`
    :param config: the method's hyper-parameters, merged with the grid's
    """

    grid: Grid
    method: str
    seed: int
    algo: str
    config: dict[str, Any]

    @property
    def name(self) -> str:
        """Of the run's folder."""
        return f"{self.method}-{self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """All that decides on a run's results but its seed, its steps and the failures of its sensors."""
        settings = {**self.config, "algo": self.algo, "env_id": self.grid.env}
        if self.grid.final_seed != FINAL_SEED:
            settings["final_seed"] = self.grid.final_seed
        return dict(json.loads(json.dumps(settings, sort_keys=True)))


def merge(own: Mapping[str, Any], hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """A method's configuration under a grid's ``hyperparams``, without ``n_timesteps``: the grid has ``steps``."""
    merged = {**own, **hyperparams}
    if "env_kwargs" in merged:
        merged["env_kwargs"] = {**own.get("env_kwargs", {}), **hyperparams.get("env_kwargs", {})}
    if "policy_kwargs" in merged:
        merged["policy_kwargs"] = {**hyperparams.get("policy_kwargs", {}), **own.get("policy_kwargs", {})}
    merged.pop("n_timesteps", None)
    return merged


def method_name(method: str) -> str:
    """Of an entry of ``methods``: itself, or the name of the file."""
    return Path(method).stem if method.endswith((".yml", ".yaml")) else method


def read_grid(path: Path) -> Grid:
    """Read and check a grid.

    :param path: YAML file; its name without the ending is the grid's
    :raises GridError: if a key is unknown or missing, or a value is not what it has to be
    """
    try:
        given = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise GridError(f"{path} is not YAML: {error}") from None
    if not isinstance(given, dict):
        raise GridError(f"{path}: expected keys and values such as 'steps: 30000', got {given!r}")
    try:
        values = _checked(given, GRID_KEYS, ("methods", "seeds"))
        values["methods"] = tuple(_found(method, path.parent) for method in values["methods"])
        grid = Grid(name=path.stem, **values)
        _check_whole(grid)
        grid.jobs()
        grid.overruled()
    except GridError as error:
        raise GridError(f"{path}: {error}") from None
    return grid


def _check_whole(grid: Grid) -> None:
    """What no key tells by itself."""
    module, _, env_id = grid.env.rpartition(":")
    try:
        if module:
            import_module(module)
        gym.spec(env_id)
    except (gym.error.Error, ImportError) as error:
        raise GridError(f"env: {grid.env!r} is not registered: {error}") from None
    names = [method_name(method) for method in grid.methods]
    lists = {"methods": names, "seeds": grid.seeds, "weathers": grid.weathers, "modalities": grid.modalities}
    for key, items in lists.items():
        if twice := [item for item in items if list(items).count(item) > 1]:
            raise GridError(f"{key}: {twice[0]!r} is there twice; every one may stand there once")
    if grid.env in OWN_ENVS and (unknown := [weather for weather in grid.weathers if weather not in WEATHERS]):
        raise GridError(f"weathers: there is no {unknown[0]!r}{_remedy(unknown[0], WEATHERS)}")
    if grid.env in OWN_ENVS and (unknown := [name for name in grid.modalities if name not in SENSORS]):
        raise GridError(f"modalities: there is no {unknown[0]!r}{_remedy(unknown[0], SENSORS)}")
    if grid.env == "CarlaVision-v0" and grid.eval_envs > 1:
        raise GridError(f"eval_envs: {grid.eval_envs} environments cannot share a CARLA server; write eval_envs: 1")
    if "n_timesteps" in grid.hyperparams:
        raise GridError("hyperparams: n_timesteps does nothing here; the steps of all runs are 'steps'")
    for part in ("env_kwargs", "policy_kwargs"):
        if not isinstance(grid.hyperparams.get(part, {}), dict):
            raise GridError(f"hyperparams: {part}: expected keys and values, got {grid.hyperparams[part]!r}")
    if "modalities" in grid.hyperparams.get("env_kwargs", {}):
        raise GridError(
            "hyperparams: env_kwargs: modalities would give rgb several sensors; put them under the grid's own key "
            f"modalities: {grid.hyperparams['env_kwargs']['modalities']!r}, which reaches the methods that have several"
        )
    if grid.failures is not None and grid.failures.episodes > grid.final_episodes:
        raise GridError(
            f"failures: episodes: {grid.failures.episodes} is more than final_episodes, {grid.final_episodes}: "
            "they are compared with the healthy car in the first of those; use at most as many"
        )


def _found(method: str, folder: Path) -> str:
    """The configuration of a method: a file beside the grid, or the name of one in ``zoo_configs``."""
    if method_name(method) != method:
        for path in (folder / method, Path(method)):
            if path.is_file():
                return str(path)
        raise GridError(f"methods: there is no file {method!r}, neither from {folder.resolve()} nor from here")
    try:
        path = config_path(method)
    except FileNotFoundError:
        raise GridError(f"methods: there is no zoo_configs/{method}.yml{_remedy(method, config_names())}") from None
    if path == Path(method):
        raise GridError(f"methods: {method!r} is a file here; name it with its ending, .yml")
    return method


def _remedy(word: str, known: Iterable[str]) -> str:
    """The right word for a wrong one, if one is near; else all."""
    known = sorted(known)
    near = get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"


def _checked(given: Mapping[str, Any], readers: Mapping[str, Reader], needed: Iterable[str]) -> dict[str, Any]:
    if unknown := [key for key in given if key not in readers]:
        raise GridError(f"unknown key {unknown[0]!r}{_remedy(str(unknown[0]), readers)}")
    if missing := [key for key in needed if key not in given]:
        raise GridError(f"{missing[0]!r} is missing; add it")
    values = {}
    for key, value in given.items():
        try:
            values[key] = readers[key](value)
        except GridError as error:
            raise GridError(f"{key}: {error}") from None
        except ValueError as error:
            raise GridError(f"{key}: expected {error}, got {value!r}") from None
    return values


def _whole(least: int, most: float = float("inf")) -> Reader:
    def read(value: Any) -> int:
        whole = isinstance(value, int | float) and not isinstance(value, bool) and value % 1 == 0
        if not whole or not least <= value <= most:
            raise ValueError(f"a whole number >= {least}" if most == float("inf") else f"one of {least} to {most}")
        return int(value)

    return read


def _list_of(what: str, read: Reader) -> Reader:
    def read_list(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list) or not value:
            raise ValueError(f"a list of {what}")
        try:
            return tuple(map(read, value))
        except GridError:
            raise
        except ValueError:
            raise ValueError(f"a list of {what}") from None

    return read_list


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError("a name")
    return value


def _mapping(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("keys and values such as {batch_size: 64}")
    return value


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _hyperparams(value: Any) -> dict[str, Any]:
    for key, item in _mapping(value).items():
        if isinstance(item, dict):
            _hyperparams(item)
        if isinstance(item, str) and _is_number(item):
            raise GridError(f"{key}: {item} is a word in YAML; write !!float {item}")
    return dict(value)


def _kind(value: Any) -> str:
    known = {kind for sensor in SENSORS for kind in failures_for(sensor)}
    if value not in known:
        raise GridError(f"there is no {value!r}{_remedy(str(value), known)}")
    return str(value)


def _failures(value: Any) -> Failures:
    return Failures(**_checked(_mapping(value), FAILURE_KEYS, ("kinds",)))


Reader = Callable[[Any], Any]
FAILURE_KEYS: dict[str, Reader] = {
    "kinds": _list_of("kinds of failure", _kind),
    "severity": _whole(1, 3),
    "episodes": _whole(1),
}
GRID_KEYS: dict[str, Reader] = {
    "env": _text,
    "steps": _whole(1),
    "methods": _list_of("names", _text),
    "seeds": _list_of("whole numbers >= 0", _whole(0)),
    "weathers": _list_of("names", _text),
    "modalities": _list_of("names", _text),
    "hyperparams": _hyperparams,
    "eval_freq": _whole(0),
    "eval_episodes": _whole(1),
    "eval_envs": _whole(1),
    "final_episodes": _whole(1),
    "final_seed": _whole(0),
    "save_freq": _whole(0),
    "failures": _failures,
}
