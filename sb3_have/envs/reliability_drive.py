"""
ReliabilityDrive-v0: a winding road seen through several vector sensors, any of which may fail at any time.

A small task in which it matters whom to believe. The state of the drive is a vector of 12 numbers; each modality shows
a part of it through a fixed random encoding, and every number is in two of the modalities: one alone is not enough, and
any one may fail without loss. Modalities go black, freeze or turn to noise in segments of 25 steps on average, at least
one is sound at any time, and nothing but the modality's own values tells which.

All environments of a batch are simulated at once (:class:`DriveBatch`), each with a random generator of its own, so
that a batch equals as many single ones step for step; :class:`ReliabilityDriveEnv` is a batch of one.

Dynamics are in road coordinates: s along the road, y to the left of its centre, heading relative to its direction.
Metres, seconds and radians. In the shapes, N is the number of environments, d of modalities.
"""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

CONDITIONS = ("sound", "black", "frozen", "noise")
"""What a modality can be in; all but the first are failures."""

DT = 0.2
HALF_WIDTH = 5.0
TOP_SPEED = 18.0
PAY_SPEED = 10.0
ALONG, ACROSS = 4.0, 4.0
"""Greatest acceleration [m/s^2]."""
LATERAL_DRAG = 1.0
"""[1/s]"""
BENDS = np.array([[0.006, 190.0], [0.006, 110.0], [0.004, 61.0]])
"""Amplitude [1/m] and wavelength [m] of the waves whose sum is the road's curvature."""
SPEED_LIMIT = (10.0, 5.0, 300.0)
"""Mean and amplitude [m/s] and wavelength [m] of the speed to hold along the road."""
PREVIEW = np.array([0.0, 10.0, 20.0])
"""How far ahead [m] the state tells the curvature; the speed to hold is told here and at the last."""
N_OBSTACLES = 2
OBSTACLE_SPEED = 5.0
CLEARANCE = (4.0, 1.6)
"""Distance along and across the road [m] at which an obstacle's cost has fallen to 1/e."""
N_STATE = 12
"""Offset, heading, speed, three curvatures, two speeds to hold, and distance and offset of both obstacles."""

RANK = 8
"""Directions of the state that a modality sees: too few for one modality, enough for two."""
CHANNELS = 16
"""Numbers in a frame."""
GAIN = 1.2
CHANGE_SCALE = 4.0
"""Of the change since the last frame, which is the other half of an observation."""
SENSOR_NOISE = 0.02
FAILURE_NOISE = 0.8
"""Standard deviation of a frame of noise, about that of a sound one."""
MEAN_SEGMENT = 25
MAX_VALUE = 2.0
N_RESET_DRAWS = len(BENDS) + 4 + 3 * N_OBSTACLES


class Encoding(NamedTuple):
    """How the modalities show the state: of ``RANK`` random directions each, through a random layer."""

    weight: np.ndarray
    """(d, N_STATE, CHANNELS), of rank ``RANK``."""
    bias: np.ndarray
    """(d, CHANNELS)."""

    @classmethod
    def draw(cls, n_modalities: int, seed: int) -> "Encoding":
        rng = np.random.default_rng(seed)
        directions = np.linalg.qr(rng.normal(size=(n_modalities, N_STATE, RANK))).Q
        weight = directions @ rng.normal(size=(n_modalities, RANK, CHANNELS)) * GAIN / np.sqrt(RANK)
        return cls(weight, 0.3 * rng.normal(size=(n_modalities, CHANNELS)))

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """Frames (N, d, CHANNELS) of states (N, N_STATE)."""
        # A sum and not a matrix product, whose rounding depends on the number of rows
        frames: np.ndarray = np.tanh((state[:, None, :, None] * self.weight).sum(axis=2) + self.bias)
        return frames


class DriveBatch:
    """
    N drives at once.

    :param num_envs: N
    :param n_modalities: d, 2 to 6
    :param corruption: probability with which a modality fails in a segment (if all would, one is spared); 0 is never
    :param failure: (modality, kind): this modality is in this condition all the time, e.g. ``(0, "black")``; another
        one stays sound
    :param max_episode_steps: steps until an episode is cut
    :param encoding_seed: of the random encoding, which is part of the task and not of the episode
    :raises ValueError: naming the option, if one is out of range
    """

    def __init__(
        self,
        num_envs: int,
        n_modalities: int = 3,
        corruption: float = 0.5,
        failure: tuple[int, str] | None = None,
        max_episode_steps: int = 200,
        encoding_seed: int = 0,
    ):
        _check_options(n_modalities, corruption, failure, max_episode_steps)
        self.num_envs, self.n_modalities = num_envs, n_modalities
        self.corruption, self.max_episode_steps = corruption, max_episode_steps
        self.failure = None if failure is None else (failure[0], CONDITIONS.index(failure[1]))
        self.encoding = Encoding.draw(n_modalities, encoding_seed)
        box = spaces.Box(-MAX_VALUE, MAX_VALUE, (2 * CHANNELS,), np.float32)
        self.observation_space = spaces.Dict({f"m{i}": box for i in range(n_modalities)})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.rngs: list[np.random.Generator] = [np.random.default_rng() for _ in range(num_envs)]
        self.steps = np.zeros(num_envs, int)
        self.s, self.y, self.drifting, self.speed = np.zeros((4, num_envs))
        self.phases = np.zeros((num_envs, len(BENDS) + 1))
        self.obstacles = np.zeros((num_envs, N_OBSTACLES, 3))  # s, mean offset, phase of the sway
        self.condition = np.zeros((num_envs, n_modalities), int)
        self.frames = np.zeros((num_envs, n_modalities, 2 * CHANNELS), np.float32)  # the newest, and its change

    def reset(self, rows: np.ndarray) -> None:
        """Begins new episodes in these environments, int (n,)."""
        draws = np.stack([self.rngs[row].random(N_RESET_DRAWS) for row in rows])
        n_phases = len(BENDS) + 1
        self.phases[rows] = 2 * np.pi * draws[:, :n_phases]
        start = 2 * draws[:, n_phases : n_phases + 3] - 1
        self.steps[rows], self.s[rows] = 0, 0.0
        self.y[rows], self.drifting[rows], self.speed[rows] = 2 * start[:, 0], start[:, 1], 10 + 4 * start[:, 2]
        obstacles = draws[:, n_phases + 3 :].reshape(-1, N_OBSTACLES, 3)
        self.obstacles[rows, :, 0] = 35 + 55 * np.arange(N_OBSTACLES) + 20 * obstacles[:, :, 0]
        self.obstacles[rows, :, 1] = 2.5 * (2 * obstacles[:, :, 1] - 1)
        self.obstacles[rows, :, 2] = 2 * np.pi * obstacles[:, :, 2]
        self._sense(rows, first=True)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :param actions: (N, 2), throttle and steering to the left in [-1, 1]
        :return: rewards, and whether the car left the road (the end) or the time is up, (N,) each
        """
        throttle, push = np.clip(np.asarray(actions, dtype=float), -1, 1).T
        drift = self.curvature(self.s) * self.speed**2
        self.drifting = self.drifting + DT * (ACROSS * push - drift - LATERAL_DRAG * self.drifting)
        self.speed = np.clip(self.speed + DT * ALONG * throttle, 0, TOP_SPEED)
        self.y = self.y + DT * self.drifting
        self.s = self.s + DT * self.speed
        self.steps += 1
        self._move_obstacles()

        distance, offset = self.obstacle_positions()
        nearness = np.exp(-((distance / CLEARANCE[0]) ** 2) - (offset / CLEARANCE[1]) ** 2).sum(axis=1)
        pace = np.maximum(0, 1 - np.abs(self.speed - self.speed_limit(self.s)) / 6)
        rewards = self.speed / PAY_SPEED * pace * (1 - (self.y / HALF_WIDTH) ** 2) - nearness
        left_road = np.abs(self.y) > HALF_WIDTH
        rewards = np.where(left_road, 0.0, rewards)
        self._sense(np.arange(self.num_envs))
        return rewards, left_road, ~left_road & (self.steps >= self.max_episode_steps)

    def _move_obstacles(self) -> None:
        """Each goes its way; those that have fallen behind come back far ahead."""
        draws = np.stack([rng.random((N_OBSTACLES, 2)) for rng in self.rngs])  # as many in every step
        self.obstacles[:, :, 0] += DT * OBSTACLE_SPEED
        behind = self.obstacles[:, :, 0] < self.s[:, None] - 10
        far = self.s[:, None] + 80 + 30 * draws[:, :, 0]
        self.obstacles[:, :, 0] = np.where(behind, far, self.obstacles[:, :, 0])
        self.obstacles[:, :, 1] = np.where(behind, 2.5 * (2 * draws[:, :, 1] - 1), self.obstacles[:, :, 1])

    def curvature(self, s: np.ndarray) -> np.ndarray:
        """Of the road [1/m] at s (N,), left is positive."""
        return (BENDS[:, 0] * np.sin(2 * np.pi * s[:, None] / BENDS[:, 1] + self.phases[:, :-1])).sum(axis=1)

    def speed_limit(self, s: np.ndarray) -> np.ndarray:
        """The speed to hold [m/s] at s (N,)."""
        mean, amplitude, wavelength = SPEED_LIMIT
        return mean + amplitude * np.sin(2 * np.pi * s / wavelength + self.phases[:, -1])

    def obstacle_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance along the road and offset across it, relative to the car, (N, N_OBSTACLES) each, the first first."""
        distance = self.obstacles[:, :, 0] - self.s[:, None]
        sway = 1.2 * np.sin(0.4 * DT * self.steps[:, None] + self.obstacles[:, :, 2])
        offset = self.obstacles[:, :, 1] + sway - self.y[:, None]
        order = np.argsort(distance, axis=1)
        return np.take_along_axis(distance, order, axis=1), np.take_along_axis(offset, order, axis=1)

    def state(self) -> np.ndarray:
        """What there is to know, (N, N_STATE), in numbers of about 1."""
        mean, amplitude, _ = SPEED_LIMIT
        distance, offset = self.obstacle_positions()
        columns = [self.y / HALF_WIDTH, self.drifting / 2, (self.speed - mean) / 4]
        columns += [100 * self.curvature(self.s + ahead) for ahead in PREVIEW]
        columns += [(self.speed_limit(self.s + ahead) - mean) / amplitude for ahead in PREVIEW[[0, -1]]]
        columns += [np.clip(distance / 30, -1, 2).T[i] for i in range(N_OBSTACLES)]
        columns += [np.clip(offset / 4, -2, 2).T[i] for i in range(N_OBSTACLES)]
        return np.stack(columns, axis=1)

    def _sense(self, rows: np.ndarray, first: bool = False) -> None:
        """Appends a frame to the observations of these environments; the first one of an episode fills them."""
        d = self.n_modalities
        uniform = np.stack([self.rngs[row].random(2 + 2 * d) for row in rows])
        normal = np.stack([self.rngs[row].standard_normal((d, CHANNELS)) for row in rows])
        changes = first | (uniform[:, 0] < 1 / MEAN_SEGMENT)
        self.condition[rows] = np.where(changes[:, None], self._draw_conditions(uniform[:, 1:]), self.condition[rows])
        sound = np.clip(self.encoding(self.state()[rows]) + SENSOR_NOISE * normal, -MAX_VALUE, MAX_VALUE)
        noise = np.clip(FAILURE_NOISE * normal, -MAX_VALUE, MAX_VALUE)
        before = sound if first else self.frames[rows, :, :CHANNELS]
        choices = np.stack([sound, np.zeros_like(sound), before, noise])
        frame = np.take_along_axis(choices, self.condition[None, rows, :, None], axis=0)[0]
        self.frames[rows, :, :CHANNELS] = frame
        self.frames[rows, :, CHANNELS:] = np.clip(CHANGE_SCALE * (frame - before), -MAX_VALUE, MAX_VALUE)

    def _draw_conditions(self, uniform: np.ndarray) -> np.ndarray:
        """Of a new segment, int (n, d), from uniform numbers (n, 1 + 2 d)."""
        d = self.n_modalities
        fails = uniform[:, 1 : 1 + d] < self.corruption
        spared = (d * uniform[:, 0]).astype(int)
        if self.failure is not None:
            fails[:, self.failure[0]] = True
            spared = (self.failure[0] + 1 + ((d - 1) * uniform[:, 0]).astype(int)) % d
        fails[fails.all(axis=1), spared[fails.all(axis=1)]] = False
        condition = np.where(fails, 1 + (3 * uniform[:, 1 + d :]).astype(int), 0)
        if self.failure is not None:
            condition[:, self.failure[0]] = self.failure[1]
        return condition

    @property
    def reliable(self) -> np.ndarray:
        """Which modality is sound, bool (N, d)."""
        return self.condition == 0

    def observation(self) -> dict[str, np.ndarray]:
        """Of all environments, {modality: float32 (N, 2 * CHANNELS)}, oldest frame first."""
        return {f"m{i}": self.frames[:, i].reshape(self.num_envs, -1).copy() for i in range(self.n_modalities)}

    def info(self, row: int) -> dict[str, Any]:
        """
        Of one environment: ``reliable`` bool (d,), ``condition`` (names), ``distance`` [m], ``speed`` [m/s],
        ``offroad``.
        """
        return {
            "reliable": self.reliable[row],
            "condition": tuple(CONDITIONS[code] for code in self.condition[row]),
            "distance": float(self.s[row]),
            "speed": float(self.speed[row]),
            "offroad": bool(abs(self.y[row]) > HALF_WIDTH),
        }


class ReliabilityDriveEnv(gym.Env[dict[str, np.ndarray], np.ndarray]):
    """
    One drive. Observation: ``m0``, ``m1``, ... float32 (48,) each, three frames of 16 numbers, oldest first. Action:
    throttle and steering (to the left) in [-1, 1]. Reward of a step: (1 - |v - v_hold| / 6 m/s, at least 0) times
    (1 - (y / 5 m)^2), less the nearness of the obstacles (1 each at their centre). Leaving the road ends the episode.

    ``info["reliable"]`` (d,) is the truth about the modalities, for study; see :meth:`DriveBatch.info`.

    :param render_mode: None, there is nothing to see
    :param options: of :class:`DriveBatch`
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, render_mode: None = None, **options: Any):
        self.render_mode = render_mode
        self.batch = DriveBatch(1, **options)
        self.observation_space, self.action_space = self.batch.observation_space, self.batch.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.batch.rngs = [self.np_random]
        self.batch.reset(np.array([0]))
        return self._observation(), self.batch.info(0)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        rewards, terminated, truncated = self.batch.step(np.asarray(action)[None])
        return self._observation(), float(rewards[0]), bool(terminated[0]), bool(truncated[0]), self.batch.info(0)

    def _observation(self) -> dict[str, np.ndarray]:
        return {key: value[0] for key, value in self.batch.observation().items()}


def _check_options(
    n_modalities: int, corruption: float, failure: tuple[int, str] | None, max_episode_steps: int
) -> None:
    if not (isinstance(n_modalities, int) and 2 <= n_modalities <= 6):
        raise ValueError(f"n_modalities={n_modalities!r}: expected a whole number from 2 to 6.")
    if not 0 <= corruption <= 1:
        raise ValueError(f"corruption={corruption!r}: expected a probability in [0, 1].")
    if not (isinstance(max_episode_steps, int) and max_episode_steps >= 1):
        raise ValueError(f"max_episode_steps={max_episode_steps!r}: expected a whole number of steps, from 1 on.")
    if failure is None:
        return
    if not (isinstance(failure, (tuple, list)) and len(failure) == 2):
        raise ValueError(f"failure={failure!r}: expected (modality, kind), e.g. (0, 'black').")
    if failure[0] not in range(n_modalities):
        raise ValueError(f"failure={failure!r}: expected a modality from 0 to {n_modalities - 1}.")
    if failure[1] not in CONDITIONS[1:]:
        raise ValueError(f"failure={failure!r}: expected a kind out of {CONDITIONS[1:]}.")
