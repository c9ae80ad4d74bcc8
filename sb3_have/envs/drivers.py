"""Rule-based drivers with the ``predict`` of an SB3 model, as baselines for agents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class RuleDriver:
    """
    Base class of drivers that need no images. Actions are those of HighwayVision-v0, [throttle, steer] in -1..1.

    Observations do not contain the speed, so rule-based drivers take it from ``info``: :func:`~sb3_have.evaluate`
    passes the ``info`` of every reset and step to :meth:`read_infos`. In your own loop, call it before every
    :meth:`predict`.
    """

    def read_infos(self, infos: Sequence[dict[str, Any]]) -> None:
        """
        Store what the driver needs to know.

        :param infos: Latest ``info`` of each environment.
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
        """
        Return the next actions, like ``BaseAlgorithm.predict``.

        :param observation: Not used.
        :param state: Returned unchanged.
        :param episode_start: One flag per environment, (n,); None for a single environment.
        :param deterministic: Not used.
        :return: Actions, float32 (n, 2), or (2,) without ``episode_start``; and the state.
        """
        if episode_start is None:
            return self._act(1)[0], state
        return self._act(len(episode_start)), state


class RandomDriver(RuleDriver):
    """
    Uniform random actions.

    :param seed: Seed of the random generator.
    """

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)

    def _act(self, n_envs: int) -> np.ndarray:
        return self._rng.uniform(-1.0, 1.0, size=(n_envs, 2)).astype(np.float32)


class KeepStraightDriver(RuleDriver):
    """
    Keeps its lane at a constant speed and ignores all traffic.

    :param target_speed: Speed in m/s.
    :param max_acceleration: Acceleration of the car at full throttle in m/s^2.
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
        # Accelerate so as to reach the target speed in one second
        throttle = np.clip((self.target_speed - self._speeds) / self.max_acceleration, -1.0, 1.0)
        return np.stack([throttle, np.zeros(n_envs)], axis=1).astype(np.float32)
