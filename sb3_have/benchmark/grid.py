"""
The grid of a benchmark: which methods and seeds to train, for how long, and how to evaluate them.

A grid is a YAML file; only ``methods`` and ``seeds`` are required::

    env: HighwayVision-v0
    steps: 30000
    methods: [gve, lve, have]      # from zoo_configs, or files relative to the grid's; a method is named after its file
    seeds: [0, 1, 2]               # runs are ordered by seed, then by method
    weathers: [ClearNoon, ...]     # default: all eight
    hyperparams: {env_kwargs: {vehicles_count: 20}, batch_size: 64}
    modalities: [rgb, event]       # default: each method's own
    eval_freq: 5000                # steps between the points of the learning curve, 0 for none
    eval_episodes: 1               # episodes of a point, in each weather
    final_episodes: 10             # episodes after training, in each weather
    final_seed: 2000000            # seed of those episodes; a search uses other episodes than the tables
    eval_envs: 16                  # number of environments of an evaluation, in the process of the run
    save_freq: 5000                # steps between checkpoints
    failures: {kinds: [black, frozen, noise], severity: 3, episodes: 1}   # default: no sensor failures

``hyperparams`` override those of every method. ``env_kwargs`` and ``policy_kwargs`` are merged key by key:
``{env_kwargs: {image_size: 84}}`` changes nothing else. They cannot change ``policy_kwargs`` that a method has itself,
because those make it that method. For the same reason ``modalities`` is a key of its own and not part of
``env_kwargs``: it changes the sensors of every method that has several, and leaves ``rgb`` its one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, field_validator, model_validator

from sb3_have.benchmark.reading import method_name
from sb3_have.configuration import algorithm_of, config_path, known_keys, load_config, suggest
from sb3_have.envs.weather import WEATHERS
from sb3_have.sensors import SENSORS, failures_for

# Seed of the episodes after training, the same for all methods and seeds. No run is trained on these episodes or
# selected by them (:data:`sb3_have.evaluation.callback.EVALUATION_SEED`).
FINAL_SEED = 2_000_000

OWN_ENVS = ("HighwayVision-v0", "CarlaVision-v0")


class GridError(ValueError):
    """A grid that cannot be run. The message names the key, its value and the remedy."""


class Failures(BaseModel):
    """
    Sensor failures for whole episodes after training.

    :param kinds: Kinds of failure, see :data:`sb3_have.sensors.failures.FAILURES`; each on every modality that has it
    :param severity: 1, 2 or 3
    :param episodes: Number of episodes in each weather, the first ones of the final evaluation
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kinds: tuple[str, ...] = Field(min_length=1)
    severity: int = Field(3, ge=1, le=3)
    episodes: int = Field(1, ge=1)

    @field_validator("kinds")
    @classmethod
    def _known_kinds(cls, kinds: tuple[str, ...]) -> tuple[str, ...]:
        return _known(kinds, {kind for sensor in SENSORS for kind in failures_for(sensor)})


class Grid(BaseModel):
    """Methods x seeds and how they are evaluated. The fields are the keys of the file, see this module."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    methods: tuple[str, ...] = Field(min_length=1)
    seeds: tuple[int, ...] = Field(min_length=1)
    env: str = "HighwayVision-v0"
    steps: int = Field(30_000, ge=1)
    weathers: tuple[str, ...] = Field(WEATHERS, min_length=1)
    modalities: tuple[str, ...] = ()
    hyperparams: dict[str, Any] = {}
    eval_freq: int = Field(5_000, ge=0)
    eval_episodes: int = Field(1, ge=1)
    final_episodes: int = Field(10, ge=1)
    final_seed: int = Field(FINAL_SEED, ge=0)
    eval_envs: int = Field(16, ge=1)
    save_freq: int = Field(5_000, ge=0)
    failures: Failures | None = None

    _path: Path = PrivateAttr(Path("grid.yml"))

    @property
    def name(self) -> str:
        """The name of the file, without the ending."""
        return self._path.stem

    @field_validator("methods", "seeds", "weathers", "modalities")
    @classmethod
    def _unique(cls, items: tuple[Any, ...]) -> tuple[Any, ...]:
        names = [method_name(str(item)) for item in items]
        if repeated := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"{repeated[0]!r} is listed twice")
        return items

    @field_validator("*", mode="before")
    @classmethod
    def _no_booleans(cls, value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("a boolean is not a number")
        return value

    @field_validator("seeds")
    @classmethod
    def _not_negative(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if min(seeds) < 0:
            raise ValueError("a seed must be 0 or more")
        return seeds

    @field_validator("env")
    @classmethod
    def _registered(cls, env: str) -> str:
        module, _, env_id = env.rpartition(":")
        try:
            if module:
                import_module(module)
            gym.spec(env_id)
        except (gym.error.Error, ImportError) as error:
            raise ValueError(f"it is not registered ({error})") from None
        return env

    @field_validator("hyperparams")
    @classmethod
    def _mappings(cls, hyperparams: dict[str, Any]) -> dict[str, Any]:
        for key in ("env_kwargs", "policy_kwargs"):
            if not isinstance(hyperparams.get(key, {}), dict):
                raise ValueError(f"{key} must be a mapping")
        if "n_timesteps" in hyperparams:
            raise ValueError("n_timesteps has no effect here; use the grid's key 'steps'")
        if "modalities" in hyperparams.get("env_kwargs", {}):
            raise ValueError("env_kwargs.modalities would give rgb several sensors; use the grid's key 'modalities'")
        _refuse_numbers_as_text(hyperparams)
        return hyperparams

    @model_validator(mode="after")
    def _consistent(self) -> Grid:
        if self.env in OWN_ENVS:
            _known(self.weathers, WEATHERS, "weathers: ")
            _known(self.modalities, SENSORS, "modalities: ")
        if self.env == "CarlaVision-v0" and self.eval_envs > 1:
            raise ValueError(f"eval_envs: {self.eval_envs} environments cannot share a CARLA server; use eval_envs: 1")
        if self.failures is not None and self.failures.episodes > self.final_episodes:
            raise ValueError(
                f"failures.episodes: {self.failures.episodes} is more than final_episodes, {self.final_episodes}, "
                "the episodes without a failure to compare with"
            )
        return self

    def jobs(self, only: Iterable[str] = ()) -> list[Job]:
        """
        Return the runs in the order of work.

        :param only: Methods to keep; all if empty
        :raises GridError: If the grid lacks one of ``only``, or a method's configuration does not fit
        """
        files = {method_name(method): self._file(method) for method in self.methods}
        configs = {name: self._config(name, file) for name, file in files.items()}
        try:
            _known(only, configs, "--only: ")
        except ValueError as error:
            raise GridError(str(error)) from None
        kept = [name for name in configs if not only or name in only]
        return [Job(self, name, seed, algorithm_of(files[name]), configs[name]) for seed in self.seeds for name in kept]

    def _file(self, method: str) -> Path:
        """Find the configuration of a method: a file beside the grid, or a name in ``zoo_configs``."""
        beside = self._path.parent / method
        try:
            return beside if beside.is_file() else config_path(method)
        except FileNotFoundError as error:
            raise GridError(f"methods: {error}") from None

    def _config(self, name: str, file: Path) -> dict[str, Any]:
        """Return the hyper-parameters of a method, merged with the grid's."""
        try:
            own = load_config(str(file), self.env)
            algo = algorithm_of(file)
        except (KeyError, ValueError) as error:
            raise GridError(f"methods: {error.args[0]}") from None
        config = merge(own, self.hyperparams)
        if self.modalities and len(config.get("env_kwargs", {}).get("modalities", self.modalities)) > 1:
            config["env_kwargs"] = {**config.get("env_kwargs", {}), "modalities": [*self.modalities]}
        if config.get("normalize"):
            raise GridError(f"hyperparams of {name}: normalize is not supported, as model.zip has no statistics")
        try:
            _known(config, known_keys(algo), f"hyperparams of {name} ({algo}): ")
        except ValueError as error:
            raise GridError(str(error)) from None
        return config


@dataclass(frozen=True)
class Job:
    """
    One run of a grid.

    :param grid: The grid
    :param method: Name of the method
    :param seed: Seed of the training
    :param algo: Name of the algorithm in :data:`sb3_have.algorithms.ALGORITHMS`
    :param config: The method's hyper-parameters, merged with the grid's
    """

    grid: Grid
    method: str
    seed: int
    algo: str
    config: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the run and its folder."""
        return f"{self.method}-{self.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that determines a run's results except its seed, its steps and the sensor failures."""
        settings = {**self.config, "algo": self.algo, "env_id": self.grid.env}
        if self.grid.final_seed != FINAL_SEED:
            settings["final_seed"] = self.grid.final_seed
        return dict(json.loads(json.dumps(settings, sort_keys=True)))


def merge(own: Mapping[str, Any], hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """
    Merge a method's configuration with a grid's ``hyperparams``. ``n_timesteps`` is dropped: the grid has ``steps``.

    :raises GridError: If they change the method's own ``policy_kwargs``
    """
    merged = {**own, **hyperparams}
    for key in {"env_kwargs", "policy_kwargs"} & merged.keys():
        merged[key] = {**own.get(key, {}), **hyperparams.get(key, {})}
    for key, value in own.get("policy_kwargs", {}).items():
        if merged["policy_kwargs"][key] != value:
            raise GridError(f"hyperparams: policy_kwargs.{key} is part of a method, which has {value!r}; remove it")
    merged.pop("n_timesteps", None)
    return merged


def read_grid(path: Path) -> Grid:
    """
    Read and check a grid.

    :param path: YAML file, whose name without the ending is the grid's
    :raises GridError: If a key is unknown or missing, or a value is wrong
    """
    try:
        given = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise GridError(f"{path} is not YAML: {error}") from None
    if not isinstance(given, dict):
        raise GridError(f"{path}: expected keys and values such as 'steps: 30000', got {given!r}")
    try:
        grid = Grid.model_validate(given)
        grid._path = path
        # Check the configurations of all methods
        grid.jobs()
    except ValidationError as errors:
        raise GridError("\n".join(f"{path}: {_in_words(error)}" for error in errors.errors())) from None
    except GridError as error:
        raise GridError(f"{path}: {error}") from None
    return grid


def _in_words(error: Any) -> str:
    """Describe a validation error of pydantic by its key, its value and the remedy."""
    key, kind = ".".join(map(str, error["loc"])), error["type"]
    if kind == "extra_forbidden":
        fields = Failures.model_fields if len(error["loc"]) > 1 else Grid.model_fields
        return f"unknown key {key!r}{suggest(str(error['loc'][-1]), fields)}"
    if kind == "missing":
        return f"the key {key!r} is missing"
    message = error["msg"].removeprefix("Value error, ")
    return f"{key}: {message}, got {error['input']!r}" if key else message


def _known(names: Iterable[str], known: Iterable[str], prefix: str = "") -> tuple[str, ...]:
    """Return the names, or raise an error if one is unknown."""
    names, known = tuple(names), set(known)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"{prefix}unknown name {unknown[0]!r}{suggest(unknown[0], known)}")
    return names


def _refuse_numbers_as_text(values: Mapping[str, Any]) -> None:
    """Refuse numbers such as 1e-3, which YAML reads as text: a run would fail in its first update."""
    for key, value in values.items():
        if isinstance(value, dict):
            _refuse_numbers_as_text(value)
        elif isinstance(value, str):
            try:
                float(value)
            except ValueError:
                continue
            raise ValueError(f"YAML reads {key}: {value} as text; write {key}: !!float {value}")
