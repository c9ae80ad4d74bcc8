"""A wrapper that makes a sensor fail: what fails, how badly and when is chosen; what did fail is told in ``info``."""

from __future__ import annotations

import re
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_have.sensors.checks import describe, is_number
from sb3_have.sensors.failures import FAILURES, SENSORS, UNSIGNED, failures_for

Array = NDArray[Any]
Interval = tuple[int, "int | None"]
Schedule = Interval | Sequence[Interval] | Callable[[int], bool]
Per = Literal["step", "episode"]

#: What a wrong sensor has: its properties are drawn once, from the constructor's seed.
CHIP_KINDS = ("dead_pixels", "misalignment")
#: Name of the observation in ``info`` where it is not a Dict.
WHOLE = "observation"


class SensorFailure(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Corrupts one modality of an environment, all the time, at random or at given steps.

    Spaces, dtypes and all other modalities stay as they are; without a failure the observation is the environment's,
    bit by bit. ``render()`` shows the environment, not what the broken sensor sees. Several wrappers may be nested, on
    the same modality too: the inner one fails first. Frame stacking goes outside (SB3's ``VecFrameStack``,
    gymnasium's ``FrameStackObservation``).

    The truth is in ``info`` after ``reset`` and every ``step``, always in the same form, which gymnasium's and SB3's
    vector environments pass on::

        info["sensor_failure"] == {"rgb": {"black": {"kind": "black", "severity": 2, "active": True}}}

    with a modality for every wrapped one and, within it, a ``name`` for every wrapper.

    The steps of an episode are counted from the reset, whose observation is step 0. When a failure happens is decided

    - by default: always;
    - by ``probability`` with ``per="episode"``: drawn at the reset for the whole episode;
    - by ``probability`` with ``per="step"``: drawn at every step on its own or, with ``duration``, in segments of that
      many steps on average (a Markov chain). ``probability`` is the share of failing steps either way;
    - by ``schedule``: at given steps of every episode.

    What a kind does to a sensor, and the parameters of its severities, is in
    :data:`~sb3_have.sensors.failures.FAILURES`. Two have a memory: "frozen" repeats the last image before the failure
    began (the first of the episode, if it began there), and "lag" shows the image of k steps ago (the first of the
    episode while there are fewer).

    ``reset(seed=...)`` seeds when the failures happen and how they look: the same seed gives the same bits, and the
    same failing steps at any severity. These draws come from generators of the wrapper's own, one for every modality
    and name, and leave the environment's alone.

    :param env: Any environment with a Dict observation, or a Box that is itself an image or a vector.
    :param modality: Key of the observation that fails; None for a Box observation.
    :param kind: A key of :data:`~sb3_have.sensors.failures.FAILURES` that the sensor knows
        (:func:`~sb3_have.sensors.failures.failures_for`).
    :param severity: 1, 2 or 3. "black" and "frozen" take a third, two thirds and all of the image; a sensor
        that is gone altogether is severity 3.
    :param probability: Share of the steps or episodes that fail, 0..1.
    :param schedule: ``(start, stop)``: the steps from start to before stop, or to the end with stop None; a list of
        such pairs; or a function of the step that says whether it fails (a module's own, not a lambda, if the
        environment is to be pickled).
    :param per: What ``probability`` is drawn for, "step" or "episode".
    :param duration: Mean length of a failure in steps, for ``per="step"``; None draws every step on its own.
    :param sensor: "rgb", "event", "depth" or "vector"; None takes a one-dimensional Box of floats for a vector and
        goes by the key otherwise: "event" or "depth" if one of its words begins so (``dvs_events``, ``DepthMap``), else
        "rgb". It must be given where that leaves doubt (``event_depth``, ``prevention``).
    :param seed: Fixes what is a property of the chip and the same in every episode: which pixels are dead, where a
        misaligned sensor looks. An integer >= 0.
    :param name: Key in ``info``, the kind by default; to tell two failures of one kind on one modality apart.
    :param signed: For an event image: whether its codes fall below 128, as in the representations "sbt" and "voxel".
        With False, for "count", "polarity" and "time_surface", "noise", "event_storm" and "salt_and_pepper" only make
        events and never negative counts. (A time surface has no counts: there each makes it 1/127 more recent.)
    :raises ValueError: on an unknown modality or kind, a kind that the sensor does not know, an observation that is
        neither a uint8 (H, W, C) image nor a float vector, a key that leaves the sensor in doubt, or impossible or
        contradictory options.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        modality: str | None,
        kind: str,
        severity: int = 2,
        probability: float | None = None,
        schedule: Schedule | None = None,
        per: Per = "step",
        duration: float | None = None,
        sensor: str | None = None,
        seed: int = 0,
        name: str | None = None,
        signed: bool = True,
    ) -> None:
        self.schedule = _checked_schedule(schedule)
        gym.utils.RecordConstructorArgs.__init__(
            self, modality=modality, kind=kind, severity=severity, probability=probability, schedule=self.schedule,
            per=per, duration=duration, sensor=sensor, seed=seed, name=name, signed=signed,
            _disable_deepcopy=True,  # a function need not be copyable
        )  # fmt: skip
        gym.Wrapper.__init__(self, env)
        for option, given in (("modality", modality), ("name", name)):
            if given is not None and not isinstance(given, str):
                raise ValueError(f"{option} must be a string or None, got {given!r}")
        space = _modality_space(env.observation_space, modality)
        self.modality = modality
        self.kind = kind
        self.name = kind if name is None else name
        self.sensor = _sensor_of(space, modality, sensor)
        if kind not in failures_for(self.sensor):
            raise ValueError(
                f"kind {kind!r} is no failure of a sensor {self.sensor!r}; its kinds are "
                f"{', '.join(failures_for(self.sensor))} (another sort of sensor: give sensor=...)"
            )
        if not is_number(severity, Integral) or severity not in (1, 2, 3):
            raise ValueError(f"severity must be 1, 2 or 3, got {severity!r}")
        if not is_number(seed, Integral) or seed < 0:
            raise ValueError(f"seed must be an integer >= 0, got {seed!r}")
        if not isinstance(signed, bool) or not (signed or self.sensor == "event"):
            raise ValueError(f"signed must be True, or False for a sensor 'event', got {signed!r} for {self.sensor!r}")
        self.severity = int(severity)
        self._refuse_twin(env)

        if probability is not None and schedule is not None:
            raise ValueError("give either probability or schedule, not both")
        if probability is not None and not (is_number(probability) and 0 <= probability <= 1):
            raise ValueError(f"probability must be a number in 0..1, got {probability!r}")
        self.probability = 1.0 if probability is None else float(probability)
        if per not in get_args(Per):
            raise ValueError(f"per must be one of {get_args(Per)}, got {per!r}")
        if probability is None and (per != "step" or duration is not None):
            raise ValueError(f"per={per!r} and duration={duration!r} have no effect without a probability")
        self.per, self.duration = per, duration
        if duration is not None:
            self._check_duration(duration)

        failure = FAILURES[kind][self.sensor]
        self._function = failure.function
        self._parameters = {**failure.at(self.severity), **({} if signed else UNSIGNED.get(kind, {}))}
        self._past: deque[Array] = deque(maxlen=1 + int(self._parameters.get("steps", 0)))
        self._bounds: dict[str, Array] = {"low": space.low, "high": space.high} if self.sensor == "vector" else {}
        self._stream = zlib.crc32(f"{WHOLE if modality is None else modality}/{self.name}".encode())
        self._chip = np.random.SeedSequence(seed, spawn_key=(self._stream,))
        self._seed(None)
        self._step: int = 0
        self._active: bool = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._seed(seed)
        self._step = 0
        self._past.clear()
        return self._fail(observation, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        observation, info = self._fail(observation, info)
        return observation, reward, terminated, truncated, info

    def _seed(self, seed: int | None) -> None:
        # Two streams, so that it is the same steps that fail whatever the noise has drawn.
        streams = np.random.SeedSequence(seed, spawn_key=(self._stream,)).spawn(2)
        self._when, self._how = (np.random.default_rng(stream) for stream in streams)

    def _fail(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        self._active = self._happens()
        whole = self.modality is None
        image = observation if whole else observation[self.modality]
        if not isinstance(image, np.ndarray):
            raise ValueError(
                f"observation key {self.modality or WHOLE!r} should be an array, as its space says, got "
                f"{describe(image)}; return np.array(...) from the environment"
            )
        seen = self._corrupt(image)
        if self._active:
            observation = seen if whole else {**observation, self.modality: seen}

        truths = info.get("sensor_failure", {})
        key = WHOLE if self.modality is None else self.modality
        truth = {"kind": self.kind, "severity": self.severity, "active": self._active}
        truths = {**truths, key: {**truths.get(key, {}), self.name: truth}}
        return observation, {**info, "sensor_failure": truths}

    def _happens(self) -> bool:
        """Whether the sensor fails in this step."""
        if self.schedule is not None:
            return bool(self.schedule(self._step)) if callable(self.schedule) else _within(self.schedule, self._step)
        if self._step and self.per == "episode":
            return self._active
        chance = self.probability
        if self._step and self.duration is not None:
            # The chances to stay and to begin that keep the share of failing steps at `probability`.
            leave = 1 / self.duration
            chance = 1 - leave if self._active else leave * self.probability / (1 - self.probability)
        return bool(self._when.random() < chance)

    def _corrupt(self, image: Array) -> Array:
        """The image as the sensor gives it now. Keeps the memory of the kinds that have one, failing or not."""
        if self.kind == "lag" or (self.kind == "frozen" and not (self._active and self._past)):
            self._past.append(image.copy())
        if not self._active:
            return image
        rng = np.random.default_rng(self._chip) if self.kind in CHIP_KINDS else self._how
        extra = {"past": self._past[0]} if self._past else self._bounds
        return self._function(image, rng, **extra, **self._parameters)

    def _refuse_twin(self, env: gym.Env[Any, Any]) -> None:
        while isinstance(env, gym.Wrapper):
            if isinstance(env, SensorFailure) and (env.modality, env.name) == (self.modality, self.name):
                raise ValueError(
                    f"modality {self.modality!r} has a failure named {self.name!r} already, and info could not tell "
                    "the two apart; give this one a name=..., or list both times in one schedule"
                )
            env = env.env

    def _check_duration(self, duration: float) -> None:
        if self.per == "episode":
            raise ValueError(f"duration={duration!r} has no effect with per='episode', which fails from start to end")
        if not self.probability < 1:
            raise ValueError("a probability of 1 fails all the time; leave duration out or lower the probability")
        least = max(1.0, self.probability / (1 - self.probability))
        if not (is_number(duration) and least <= duration < np.inf):
            raise ValueError(
                f"with probability={self.probability} failures last {least:g} steps or more on average, "
                f"got duration={duration!r}"
            )


def _modality_space(space: spaces.Space[Any], modality: str | None) -> spaces.Box:
    """The Box that is to fail."""
    if isinstance(space, spaces.Dict):
        if modality not in space.spaces:
            raise ValueError(f"modality must be a key of the observation, {list(space.spaces)}, got {modality!r}")
        part = space[modality]
        if not isinstance(part, spaces.Box):
            raise ValueError(f"observation key {modality!r} must be a Box, got {part}")
        return part
    if not isinstance(space, spaces.Box):
        raise ValueError(f"SensorFailure needs a Dict or Box observation, got {space}")
    if modality is not None:
        raise ValueError(
            f"the observation is one Box without keys: give modality=None, or name it {modality!r} with "
            "DictObservation first"
        )
    return space


def _sensor_of(space: spaces.Box, modality: str | None, sensor: str | None) -> str:
    """The sort of sensor that a space holds, by shape and name; complains about what is neither image nor vector."""
    key = WHOLE if modality is None else modality
    if sensor is not None and sensor not in SENSORS:
        raise ValueError(f"sensor must be one of {SENSORS}, got {sensor!r}")
    vector = len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)
    if vector and sensor in (None, "vector"):
        return "vector"
    if vector or sensor == "vector":
        raise ValueError(f"observation key {key!r}: sensor={sensor!r} does not fit {space.dtype} {space.shape}")
    image = len(space.shape) == 3 and space.dtype == np.uint8
    if not image or (space.low != 0).any() or (space.high != 255).any():
        raise ValueError(
            f"observation key {key!r} must be a uint8 (H, W, C) image in 0..255 or a float vector (n,), got "
            f"{space.dtype} {space.shape} in {space.low.min()}..{space.high.max()}; stack frames and scale images "
            "outside of SensorFailure"
        )
    if space.shape[0] < space.shape[2]:
        raise ValueError(
            f"observation key {key!r} of shape {space.shape} has its channels first; use ChannelLastImages before "
            "SensorFailure"
        )
    return sensor or _sensor_named(key)


def _sensor_named(key: str) -> str:
    """The sort of image that a key speaks of; complains about a key that may speak of several."""
    words = [word.lower() for word in re.findall("[A-Z]?[a-z]+|[A-Z]+(?![a-z])", key)]
    named = [sensor for sensor in ("rgb", "event", "depth") if sensor in key.lower()]
    clear = [sensor for sensor in named if sensor == "rgb" or any(word.startswith(sensor) for word in words)]
    if len(named) > 1 or clear != named:
        raise ValueError(f"observation key {key!r} leaves open which sensor it is; give sensor=, one of {SENSORS[:3]}")
    return named[0] if named else "rgb"


def _checked_schedule(schedule: Schedule | None) -> tuple[Interval, ...] | Callable[[int], bool] | None:
    """Intervals as a tuple, functions as they are."""
    if schedule is None or callable(schedule):
        return schedule
    given: list[Any] = list(schedule) if isinstance(schedule, Sequence) else [schedule]
    pairs = given if all(isinstance(part, Sequence) for part in given) else [given]
    if not pairs or not all(_is_interval(pair) for pair in pairs):
        raise ValueError(
            "schedule must be (start, stop) in steps with 0 <= start < stop, stop None for the end of the episode, "
            f"a list of such pairs or a function of the step, got {schedule!r}"
        )
    return tuple((int(start), None if stop is None else int(stop)) for start, stop in pairs)


def _is_interval(pair: Sequence[Any]) -> bool:
    if len(pair) != 2 or not is_number(pair[0], Integral) or pair[0] < 0:
        return False
    return pair[1] is None or (is_number(pair[1], Integral) and bool(pair[1] > pair[0]))


def _within(intervals: Sequence[Interval], step: int) -> bool:
    return any(start <= step and (stop is None or step < stop) for start, stop in intervals)
