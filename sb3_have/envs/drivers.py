"""Rule-based drivers with the ``predict`` of an SB3 model, to compare agents with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class RuleDriver:
    """A driver that needs no images. Its actions are HighwayVision-v0's [throttle, steer], each in -1..1.

    The speed is in no observation, so a rule cannot read it there as a learned driver must infer it. It reads a
    speedometer instead: :func:`~sb3_have.evaluate` shows it the ``info`` of every reset and step by
    :meth:`read_infos`; in a loop of your own, call that before every :meth:`predict`.
    """

    def read_infos(self, infos: Sequence[dict[str, Any]]) -> None:
        """Take note of where the cars are.

        :param infos: the latest ``info`` of each environment
        """

    def _act(self, n_envs: int) -> np.ndarray:
        raise NotImplementedError

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions in the manner of SB3.

        :param observation: not looked at
        :param state: handed back
        :param episode_start: one flag per environment, shape (n,); None for a single environment
        :param deterministic: without effect
        :return: actions, float32 (n, 2), or (2,) without ``episode_start``; and the state
        """
        if episode_start is None:
            return self._act(1)[0], state
        return self._act(len(episode_start)), state


class RandomDriver(RuleDriver):
    """Uniform random actions.

    :param seed: of its generator
    """

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)

    def _act(self, n_envs: int) -> np.ndarray:
        return self._rng.uniform(-1.0, 1.0, size=(n_envs, 2)).astype(np.float32)


class KeepStraightDriver(RuleDriver):
    """Keeps its lane at a constant speed, blind to all traffic.

    :param target_speed: [m/s]
    :param max_acceleration: of the car at full throttle [m/s^2]
    """

    def __init__(self, target_speed: float = 25.0, max_acceleration: float = 5.0) -> None:
        self.target_speed = target_speed
        self.max_acceleration = max_acceleration
        self._speeds: np.ndarray | None = None

    def read_infos(self, infos: Sequence[dict[str, Any]]) -> None:
        if not all("speed" in info for info in infos):
            raise KeyError("KeepStraightDriver needs info['speed'] [m/s] after every reset and step")
        self._speeds = np.array([info["speed"] for info in infos])

    def _act(self, n_envs: int) -> np.ndarray:
        if self._speeds is None or len(self._speeds) != n_envs:
            raise RuntimeError(f"call read_infos with the infos of the {n_envs} environments before every predict")
        # the acceleration that closes the gap in one second
        throttle = np.clip((self.target_speed - self._speeds) / self.max_acceleration, -1.0, 1.0)
        return np.stack([throttle, np.zeros(n_envs)], axis=1).astype(np.float32)
