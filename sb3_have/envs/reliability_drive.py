"""
ReliabilityDrive-v0: a winding road seen through several vector sensors, any of which may fail at any time.

A small task in which it matters whom to believe. The state of the drive is a vector of 12 numbers. Every modality shows
it through a random layer of its own, by default all but two directions of it: one modality alone is not enough, any two
are. They go black, freeze or turn to noise in segments of 25 steps on average; at least one is sound at any time, and
nothing but the modality's own values, and how much they have just changed, tells which. That is easy to tell: the task
is not to detect failures, but to make use of them. The pay goes with the speed to hold, which changes along the road,
so that the value of a state depends on what a sound modality shows, however well the car is driven.

All environments of a batch are simulated at once (:class:`DriveBatch`), each with a random generator of its own, so
that a batch equals as many single ones step for step; :class:`ReliabilityDriveEnv` is a batch of one.

Dynamics are in road coordinates: s along the road, y to the left of its centre, drift is the speed in y. Metres,
seconds and radians. In the shapes, N is the number of environments, d of modalities.
"""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

CONDITIONS = ("sound", "black", "frozen", "noise")
"""
What a modality can be in; all but the first are failures. A frozen one is stuck at what it would show in some other
state, and so of no use from the first step on; a black one shows zeros, and noise has the size of what is sound.
"""

DT = 0.2
HALF_WIDTH = 5.0
"""Of the road; beyond it the episode ends."""
TOP_SPEED = 18.0
ALONG, ACROSS = 4.0, 4.0
"""Greatest acceleration [m/s^2] by throttle and steering."""
DRAG = 1.0
"""By which the drift dies down [1/s]."""
BENDS = np.array([[0.006, 190.0], [0.006, 110.0], [0.004, 61.0]])
"""Amplitude [1/m] and wavelength [m] of the waves whose sum is the road's curvature."""
SPEED_TO_HOLD = (10.0, 4.0, 160.0)
"""Mean and amplitude [m/s] and wavelength [m] along the road."""
PREVIEW = np.array([0.0, 10.0, 20.0])
"""How far ahead [m] the state tells the curvature and the speed to hold."""
OBSTACLE_SPEED = 5.0
SWAY = (1.2, 0.4)
"""Amplitude [m] and angular frequency [1/s] of the obstacle's way across the road."""
CLEARANCE = (4.0, 1.6)
"""Distance along and across the road [m] at which the obstacle's cost has fallen to 1/e."""
N_STATE = 12
"""Offset, drift, speed; three curvatures, three speeds to hold; the obstacle's distance, offset and drift."""

CHANNELS = 16
"""Numbers in a frame."""
GAIN = 1.2
"""Of the random layer: how far into the bends of its tanh the state reaches."""
SENSOR_NOISE = 0.02
TYPICAL_CHANGE = 0.05
"""Of a number from frame to frame. The other half of an observation tells how lively each is, in octaves about this:
sound modalities are, frozen and black ones are not, and noise is much too lively."""
OCTAVES = 1.5
"""One unit in an observation."""
MAX_VALUE = 3.0
"""Bound of an observation."""
STUCK_STD = 0.5
"""Standard deviation of the random state at which a modality freezes, about that of the true one."""
FAILURE_NOISE = 0.5
"""Standard deviation of a frame of noise, about that of a sound one."""
MEAN_SEGMENT = 25
"""Steps from one draw of the conditions to the next."""
N_RESET_DRAWS = len(BENDS) + 1 + 3 + 3
"""Phases of bends and speed to hold, the car's start, the obstacle's."""


class Encoding(NamedTuple):
    """How the modalities show the state: all of it but some directions each, through a random layer."""

    weight: np.ndarray
    """(d, N_STATE, CHANNELS)."""
    bias: np.ndarray
    """(d, CHANNELS)."""

    @classmethod
    def draw(cls, n_modalities: int, n_blind: int, seed: int) -> "Encoding":
        rng = np.random.default_rng(seed)
        directions = np.linalg.qr(rng.normal(size=(N_STATE, N_STATE))).Q.T
        weight = rng.normal(size=(n_modalities, N_STATE, CHANNELS)) * GAIN / np.sqrt(N_STATE - n_blind)
        for i in range(n_modalities):
            blind = directions[np.arange(n_blind * i, n_blind * (i + 1)) % N_STATE]
            weight[i] -= blind.T @ (blind @ weight[i])
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
    :param n_blind: directions of the 12-dimensional state that a modality does not see, 0 to 11; others for each as far
        as there are enough. With 2 any two modalities of three show all of the state, with 8 each of three shows a part
        of its own
    :param encoding_seed: of the random encoding, which is part of the task and not of the episode
    :raises ValueError: naming the option, if one is out of range
    """

    def __init__(
        self,
        num_envs: int,
        n_modalities: int = 3,
        corruption: float = 0.6,
        failure: tuple[int, str] | None = None,
        max_episode_steps: int = 200,
        n_blind: int = 2,
        encoding_seed: int = 0,
    ):
        _check_options(n_modalities, corruption, failure, max_episode_steps, n_blind)
        self.num_envs, self.n_modalities = num_envs, n_modalities
        self.corruption, self.max_episode_steps = corruption, max_episode_steps
        self.failure = None if failure is None else (failure[0], CONDITIONS.index(failure[1]))
        self.encoding = Encoding.draw(n_modalities, n_blind, encoding_seed)
        box = spaces.Box(-MAX_VALUE, MAX_VALUE, (2 * CHANNELS,), np.float32)
        self.observation_space = spaces.Dict({f"m{i}": box for i in range(n_modalities)})
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.rngs: list[np.random.Generator] = [np.random.default_rng() for _ in range(num_envs)]
        self.steps = np.zeros(num_envs, int)
        self.s, self.y, self.drift, self.speed = np.zeros((4, num_envs))
        self.phases = np.zeros((num_envs, len(BENDS) + 1))
        self.obstacle = np.zeros((num_envs, 3))  # s, mean offset, phase of its sway
        self.condition = np.zeros((num_envs, n_modalities), int)
        self.stuck = np.zeros((num_envs, n_modalities, CHANNELS))  # what a frozen modality shows
        self.frames = np.zeros((num_envs, n_modalities, 2 * CHANNELS), np.float32)  # and how lively each is

    def reset(self, rows: np.ndarray) -> None:
        """Begins new episodes in these environments, int (n,)."""
        draws = np.stack([self.rngs[row].random(N_RESET_DRAWS) for row in rows])
        n_phases = len(BENDS) + 1
        self.phases[rows] = 2 * np.pi * draws[:, :n_phases]
        start = 2 * draws[:, n_phases : n_phases + 3] - 1
        self.steps[rows], self.s[rows] = 0, 0.0
        self.y[rows], self.drift[rows], self.speed[rows] = 2 * start[:, 0], start[:, 1], 10 + 4 * start[:, 2]
        place, lane, phase = draws[:, n_phases + 3 :].T
        self.obstacle[rows] = np.stack([30 + 30 * place, 5 * lane - 2.5, 2 * np.pi * phase], axis=1)
        self._sense(rows, first=True)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :param actions: (N, 2), throttle and steering to the left in [-1, 1]
        :return: rewards, and whether the car left the road (the end) or the time is up, (N,) each
        """
        throttle, push = np.clip(np.asarray(actions, dtype=float), -1, 1).T
        outwards = self.curvature(self.s) * self.speed**2
        self.drift = self.drift + DT * (ACROSS * push - outwards - DRAG * self.drift)
        self.speed = np.clip(self.speed + DT * ALONG * throttle, 0, TOP_SPEED)
        self.y = self.y + DT * self.drift
        self.s = self.s + DT * self.speed
        self.steps += 1
        self._move_obstacle()

        distance, offset, _ = self.obstacle_position()
        nearness = np.exp(-((distance / CLEARANCE[0]) ** 2) - (offset / CLEARANCE[1]) ** 2)
        pace = np.maximum(0, 1 - np.abs(self.speed - self.speed_to_hold(self.s)) / 6)
        rewards = self.speed / SPEED_TO_HOLD[0] * pace * (1 - (self.y / HALF_WIDTH) ** 2) - nearness
        left_road = np.abs(self.y) > HALF_WIDTH
        rewards = np.where(left_road, 0.0, rewards)
        self._sense(np.arange(self.num_envs))
        return rewards, left_road, ~left_road & (self.steps >= self.max_episode_steps)

    def _move_obstacle(self) -> None:
        """It goes its way; once it has fallen behind, the next one is ahead."""
        place, lane = np.stack([rng.random(2) for rng in self.rngs], axis=1)  # as many in every step
        self.obstacle[:, 0] += DT * OBSTACLE_SPEED
        behind = self.obstacle[:, 0] < self.s - 10
        self.obstacle[:, 0] = np.where(behind, self.s + 40 + 30 * place, self.obstacle[:, 0])
        self.obstacle[:, 1] = np.where(behind, 5 * lane - 2.5, self.obstacle[:, 1])

    def curvature(self, s: np.ndarray) -> np.ndarray:
        """Of the road [1/m] at s (N,), left is positive."""
        waves = BENDS[:, 0] * np.sin(2 * np.pi * s[:, None] / BENDS[:, 1] + self.phases[:, :-1])
        curvature: np.ndarray = waves.sum(axis=1)
        return curvature

    def speed_to_hold(self, s: np.ndarray) -> np.ndarray:
        """The speed to hold [m/s] at s (N,)."""
        mean, amplitude, wavelength = SPEED_TO_HOLD
        speed: np.ndarray = mean + amplitude * np.sin(2 * np.pi * s / wavelength + self.phases[:, -1])
        return speed

    def obstacle_position(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance along the road and offset across it [m], relative to the car, and drift [m/s], (N,) each."""
        amplitude, frequency = SWAY
        phase = frequency * DT * self.steps + self.obstacle[:, 2]
        offset = self.obstacle[:, 1] + amplitude * np.sin(phase) - self.y
        return self.obstacle[:, 0] - self.s, offset, amplitude * frequency * np.cos(phase)

    def state(self) -> np.ndarray:
        """What there is to know, (N, N_STATE), in numbers of about 1."""
        mean, amplitude, _ = SPEED_TO_HOLD
        distance, offset, drift = self.obstacle_position()
        columns = [self.y / HALF_WIDTH, self.drift / 2, (self.speed - mean) / 4]
        columns += [100 * self.curvature(self.s + ahead) for ahead in PREVIEW]
        columns += [(self.speed_to_hold(self.s + ahead) - mean) / amplitude for ahead in PREVIEW]
        columns += [np.clip(distance / 20, -1, 2), np.clip(offset / 4, -2, 2), 2 * drift]
        return np.stack(columns, axis=1)

    def _sense(self, rows: np.ndarray, first: bool = False) -> None:
        """Draws conditions and takes the next frame in these environments, all of which begin an episode or none."""
        d = self.n_modalities
        uniform = np.stack([self.rngs[row].random(2 + 2 * d) for row in rows])
        normal = np.stack([self.rngs[row].standard_normal((d, CHANNELS)) for row in rows])
        changes = first | (uniform[:, 0] < 1 / MEAN_SEGMENT)
        self.condition[rows] = np.where(changes[:, None], self._draw_conditions(uniform[:, 1:]), self.condition[rows])
        elsewhere = np.stack([self.rngs[row].standard_normal(N_STATE) for row in rows])
        sticks = np.repeat(changes[:, None], d, axis=1)
        if self.failure is not None:
            sticks[:, self.failure[0]] = first  # what fails for whole episodes shows the same for whole episodes
        self.stuck[rows] = np.where(sticks[:, :, None], self.encoding(STUCK_STD * elsewhere), self.stuck[rows])
        sound = np.clip(self.encoding(self.state()[rows]) + SENSOR_NOISE * normal, -MAX_VALUE, MAX_VALUE)
        noise = np.clip(FAILURE_NOISE * normal, -MAX_VALUE, MAX_VALUE)
        before = self.frames[rows, :, :CHANNELS]
        choices = np.stack([sound, np.zeros_like(sound), self.stuck[rows], noise])
        frame = np.take_along_axis(choices, self.condition[None, rows, :, None], axis=0)[0]
        self.frames[rows, :, :CHANNELS] = frame
        octaves = np.log2(np.maximum(np.abs(frame - before), 1e-6) / TYPICAL_CHANGE)
        self.frames[rows, :, CHANNELS:] = 0 if first else np.clip(octaves / OCTAVES, -MAX_VALUE, MAX_VALUE)

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
        return np.equal(self.condition, 0)

    def observation(self) -> dict[str, np.ndarray]:
        """Of all environments, {modality: float32 (N, 2 * CHANNELS)}: the frame, and how lively each number is."""
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
    One drive. Observation: ``m0``, ``m1``, ... float32 (32,) each, the 16 numbers of a frame and how lively each is.
    Action: throttle and steering to the left, in [-1, 1]. Reward of a step: v / 10 m/s, times
    ``1 - |v - v_hold| / 6 m/s`` (at least 0), times 1 - (y / 5 m)^2, less the nearness of the obstacle (1 at its
    centre). Leaving the road ends the episode; 200 steps cut it. A driver by rule who knows the state gets 179.

    ``info["reliable"]`` (d,) is the truth about the modalities, for study; see :meth:`DriveBatch.info`.

    :param render_mode: None, there is nothing to see
    :param options: of :class:`DriveBatch`
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, render_mode: None = None, **options: Any):
        self.render_mode = render_mode
        self.batch = DriveBatch(1, **options)
        self.observation_space: spaces.Space[Any] = self.batch.observation_space
        self.action_space = self.batch.action_space

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
    n_modalities: int, corruption: float, failure: tuple[int, str] | None, max_episode_steps: int, n_blind: int
) -> None:
    if not (isinstance(n_modalities, int) and 2 <= n_modalities <= 6):
        raise ValueError(f"n_modalities={n_modalities!r}: expected a whole number from 2 to 6.")
    if not 0 <= corruption <= 1:
        raise ValueError(f"corruption={corruption!r}: expected a probability in [0, 1].")
    if not (isinstance(max_episode_steps, int) and max_episode_steps >= 1):
        raise ValueError(f"max_episode_steps={max_episode_steps!r}: expected a whole number of steps, from 1 on.")
    if not (isinstance(n_blind, int) and 0 <= n_blind < N_STATE):
        raise ValueError(f"n_blind={n_blind!r}: expected a whole number of directions from 0 to {N_STATE - 1}.")
    if failure is None:
        return
    if not (isinstance(failure, (tuple, list)) and len(failure) == 2):
        raise ValueError(f"failure={failure!r}: expected (modality, kind), e.g. (0, 'black').")
    if failure[0] not in range(n_modalities):
        raise ValueError(f"failure={failure!r}: expected a modality from 0 to {n_modalities - 1}.")
    if failure[1] not in CONDITIONS[1:]:
        raise ValueError(f"failure={failure!r}: expected a kind out of {CONDITIONS[1:]}.")
