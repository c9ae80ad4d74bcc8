"""A wrapper that makes a sensor fail, and reports in ``info`` when it did."""

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

from sb3_have.sensors.checks import is_number
from sb3_have.sensors.failures import FAILURES, SENSORS, failures_for

Array = NDArray[Any]
Interval = tuple[int, "int | None"]
Schedule = Interval | Sequence[Interval] | Callable[[int], bool]
Per = Literal["step", "episode"]

# Failures of the chip itself: they are drawn once, from the seed of the constructor
CHIP_KINDS = ("dead_pixels", "misalignment")
# Key in ``info`` of an observation that is not a Dict
WHOLE = "observation"


class SensorFailure(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Corrupts one modality of an environment: always, at random, or at given steps.

    Spaces, dtypes and all other modalities stay the same, and without an active failure the observation is that of the
    environment, bit by bit. ``render()`` shows the environment, not the broken sensor. Wrappers can be nested, also on
    the same modality; the inner one fails first. Stack frames outside (SB3's ``VecFrameStack``, Gymnasium's
    ``FrameStackObservation``).

    ``info`` holds the truth after ``reset`` and every ``step``, in a form that the vector environments of Gymnasium and
    SB3 pass on::

        info["sensor_failure"] == {"rgb": {"black": {"kind": "black", "severity": 2, "active": True}}}

    with an entry for every modality and, within it, for the ``name`` of every wrapper.

    Steps are counted from the reset, whose observation is step 0. The sensor fails

    - always, by default;
    - with ``probability`` and ``per="episode"``: for whole episodes, drawn at the reset;
    - with ``probability`` and ``per="step"``: at single steps, drawn independently, or with ``duration`` in segments of
      that mean length (a Markov chain). ``probability`` is the share of failing steps in both cases;
    - with ``schedule``: at the given steps of every episode.

    :data:`~sb3_have.sensors.failures.FAILURES` defines what each kind does to each sensor. Two kinds have a memory:
    "frozen" repeats the last image before the failure (the first of the episode if it began there), and "lag" shows the
    image of k steps ago (the first of the episode until there are k).

    ``reset(seed=...)`` seeds when the failures happen and what they look like: the same seed gives the same bits, and
    the same failing steps at any severity. Each wrapper has generators of its own, which depend on modality and name.

    :param env: Environment with a Dict observation, or with a Box that is itself an image or a vector.
    :param modality: Key of the observation that fails; None for a Box observation.
    :param kind: Key of :data:`~sb3_have.sensors.failures.FAILURES` that the sensor can have
        (:func:`~sb3_have.sensors.failures_for`).
    :param severity: 1, 2 or 3. "black" and "frozen" affect one third, two thirds or all of the image, so a complete
        loss of the sensor is severity 3.
    :param probability: Share of the steps or episodes that fail, 0..1.
    :param schedule: ``(start, stop)`` for the steps from start until before stop, or to the end if stop is None; a list
        of such pairs; or a function of the step that returns whether the sensor fails (not a lambda, if the environment
        is pickled).
    :param per: What ``probability`` is drawn for, "step" or "episode".
    :param duration: Mean length of a failure in steps, for ``per="step"``. By default steps are independent.
    :param sensor: "rgb", "event", "depth" or "vector". By default a one-dimensional Box of floats is a vector, and an
        image is "event" or "depth" if its key contains this word, else "rgb".
    :param seed: Seed of what belongs to the chip and is the same in every episode: which pixels are dead, and where a
        misaligned sensor looks.
    :param name: Key in ``info``, by default the kind; needed to distinguish two failures of one kind on one modality.
    :param signed: Whether the codes of an event image may fall below 128, as in the representations "sbt" and "voxel".
        If False (for "count", "polarity" and "time_surface"), "noise", "event_storm" and "salt_and_pepper" only add
        positive counts; in a time surface each of them is 1/127.
    :raises ValueError: If the modality, the kind or an option does not fit the observation, or if options contradict
        each other.
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
        space = _modality_space(env.observation_space, modality)
        self.modality = modality
        self.key = WHOLE if modality is None else modality
        self.kind = kind
        self.name = kind if name is None else name
        self.sensor = _sensor_of(space, self.key, sensor)
        if kind not in failures_for(self.sensor):
            raise ValueError(
                f"kind must be one of {failures_for(self.sensor)} for a sensor {self.sensor!r}, got {kind!r}; for "
                "another sensor give sensor=..."
            )
        if severity not in (1, 2, 3):
            raise ValueError(f"severity must be 1, 2 or 3, got {severity!r}")
        if not signed and self.sensor != "event":
            raise ValueError(f"signed=False is only for a sensor 'event', got {self.sensor!r}")
        self.severity = int(severity)
        self._refuse_twin(env)
        self.probability, self.per, self.duration = 1.0 if probability is None else float(probability), per, duration
        self._check_times(probability)

        failure = FAILURES[kind][self.sensor]
        self._function = failure.function
        self._parameters = failure.at(self.severity, signed)
        self._past: deque[Array] = deque(maxlen=1 + int(self._parameters.get("steps", 0)))
        self._bounds: dict[str, Array] = {"low": space.low, "high": space.high} if self.sensor == "vector" else {}
        self._stream = zlib.crc32(f"{self.key}/{self.name}".encode())
        self._chip = np.random.SeedSequence(seed, spawn_key=(self._stream,))
        self._seed(None)
        self._step: int = 0
        self._active: bool = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and the failure, both with the seed."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._seed(seed)
        self._step = 0
        self._past.clear()
        return self._fail(observation, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment and corrupt its observation if the failure is active."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        observation, info = self._fail(observation, info)
        return observation, reward, terminated, truncated, info

    def _seed(self, seed: int | None) -> None:
        # Two streams, so that the failing steps do not depend on how much noise has been drawn
        streams = np.random.SeedSequence(seed, spawn_key=(self._stream,)).spawn(2)
        self._when, self._how = (np.random.default_rng(stream) for stream in streams)

    def _fail(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        self._active = self._happens()
        seen = self._corrupt(observation if self.modality is None else observation[self.modality])
        if self._active:
            observation = seen if self.modality is None else {**observation, self.modality: seen}
        truths = info.get("sensor_failure", {})
        truth = {"kind": self.kind, "severity": self.severity, "active": self._active}
        truths = {**truths, self.key: {**truths.get(self.key, {}), self.name: truth}}
        return observation, {**info, "sensor_failure": truths}

    def _happens(self) -> bool:
        """Whether the sensor fails in this step."""
        if callable(self.schedule):
            return bool(self.schedule(self._step))
        if self.schedule is not None:
            return any(start <= self._step and (stop is None or self._step < stop) for start, stop in self.schedule)
        if self._step and self.per == "episode":
            return self._active
        chance = self.probability
        if self._step and self.duration is not None:
            # Probabilities of staying and of beginning that keep the share of failing steps at `probability`
            leave = 1 / self.duration
            chance = 1 - leave if self._active else leave * self.probability / (1 - self.probability)
        return bool(self._when.random() < chance)

    def _corrupt(self, image: Array) -> Array:
        """Return the image of the sensor. Keep the past of the kinds that need it, whether they are active or not."""
        if self.kind == "lag" or (self.kind == "frozen" and not (self._active and self._past)):
            self._past.append(image.copy())
        if not self._active:
            return image
        rng = np.random.default_rng(self._chip) if self.kind in CHIP_KINDS else self._how
        extra = {"past": self._past[0]} if self._past else self._bounds
        return self._function(image, rng, **extra, **self._parameters)

    def _refuse_twin(self, env: gym.Env[Any, Any]) -> None:
        """Refuse a second failure of the same name, whose entry in ``info`` would overwrite that of the first."""
        while isinstance(env, gym.Wrapper):
            if isinstance(env, SensorFailure) and (env.key, env.name) == (self.key, self.name):
                raise ValueError(
                    f"modality {self.modality!r} already has a failure named {self.name!r}; give this one a name=..., "
                    "or list the times of both in one schedule"
                )
            env = env.env

    def _check_times(self, probability: float | None) -> None:
        """Check the options that decide when the sensor fails, and refuse those that would have no effect."""
        if self.per not in get_args(Per):
            raise ValueError(f"per must be one of {get_args(Per)}, got {self.per!r}")
        if probability is not None and self.schedule is not None:
            raise ValueError("give either probability or schedule, not both")
        if not 0 <= self.probability <= 1:
            raise ValueError(f"probability must lie in 0..1, got {probability!r}")
        if probability is None and (self.per != "step" or self.duration is not None):
            raise ValueError(f"per={self.per!r} and duration={self.duration!r} have no effect without a probability")
        if self.duration is None:
            return
        if self.per == "episode" or self.probability == 1:
            raise ValueError(f"duration={self.duration!r} has no effect on failures that last for the whole episode")
        # Shorter failures cannot fill this share of the steps
        least = max(1.0, self.probability / (1 - self.probability))
        if not least <= self.duration < np.inf:
            raise ValueError(
                f"with probability={self.probability} the mean duration is at least {least:g} steps, got "
                f"{self.duration!r}"
            )


def _modality_space(space: spaces.Space[Any], modality: str | None) -> spaces.Box:
    """Space of the modality that fails."""
    part = space
    if isinstance(space, spaces.Dict):
        if modality not in space.spaces:
            raise ValueError(f"modality must be a key of the observation, {list(space.spaces)}, got {modality!r}")
        part = space[modality]
    elif modality is not None:
        raise ValueError(
            f"the observation has no keys: give modality=None, or name it {modality!r} with DictObservation"
        )
    if not isinstance(part, spaces.Box):
        raise ValueError(f"SensorFailure needs a Dict or Box observation whose modality is a Box, got {part}")
    return part


def _sensor_of(space: spaces.Box, key: str, sensor: str | None) -> str:
    """Kind of sensor, by option, shape and key. Refuse what is neither an image nor a vector."""
    if sensor is not None and sensor not in SENSORS:
        raise ValueError(f"sensor must be one of {SENSORS}, got {sensor!r}")
    vector = len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)
    if vector and sensor in (None, "vector"):
        return "vector"
    if vector or sensor == "vector":
        raise ValueError(f"observation key {key!r}: sensor={sensor!r} does not fit {space.dtype} {space.shape}")
    image = len(space.shape) == 3 and space.dtype == np.uint8 and space.shape[0] >= space.shape[2]
    if not image or (space.low != 0).any() or (space.high != 255).any():
        raise ValueError(
            f"observation key {key!r} must be a uint8 (H, W, C) image in 0..255 or a float vector (n,), got "
            f"{space.dtype} {space.shape} in {space.low.min()}..{space.high.max()}; use ChannelLastImages inside of "
            "SensorFailure, and stack frames outside of it"
        )
    # Names count at the start of a word: "seventh" is no event camera
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", key)]
    named = [name for name in ("rgb", "event", "depth") if any(word.startswith(name) for word in words)]
    if sensor is None and len(named) > 1:
        raise ValueError(f"observation key {key!r} names several sensors; give sensor=, one of {SENSORS[:3]}")
    return sensor or (named[0] if named else "rgb")


def _checked_schedule(schedule: Schedule | None) -> tuple[Interval, ...] | Callable[[int], bool] | None:
    """Return intervals as a tuple of pairs, and functions as they are."""
    if schedule is None or callable(schedule):
        return schedule
    given: list[Any] = list(schedule) if isinstance(schedule, Sequence) else [schedule]
    pairs = given if all(isinstance(part, Sequence) for part in given) else [given]
    if not pairs or not all(_is_interval(pair) for pair in pairs):
        raise ValueError(
            "schedule must be (start, stop) in steps with 0 <= start < stop, where stop may be None, a list of such "
            f"pairs, or a function of the step, got {schedule!r}"
        )
    return tuple((int(start), None if stop is None else int(stop)) for start, stop in pairs)


def _is_interval(pair: Sequence[Any]) -> bool:
    if len(pair) != 2 or not is_number(pair[0], Integral) or pair[0] < 0:
        return False
    return pair[1] is None or (is_number(pair[1], Integral) and bool(pair[1] > pair[0]))
