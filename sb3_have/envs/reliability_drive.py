"""
ReliabilityDrive-v0: a winding road seen through several vector sensors, any of which may fail at any time.

A small task about which modality to trust. The state of the drive has 12 dimensions. Each modality observes it through
a random layer of its own, by default all but two directions, so that one modality alone is not enough but any two are.
Modalities go black, freeze or turn to noise in segments of 25 steps on average; at least one is always sound. Only the
values of a modality, and how much they have just changed, reveal its condition. This is easy to detect: the task is not
to detect failures but to use that knowledge. The reward depends on a target speed that changes along the road, so the
value of a state depends on what the sound modalities show, however well the car is driven.

All environments of a batch are simulated at once (:class:`DriveBatch`), each with its own random generator, so that a
batch equals single environments step for step. :class:`ReliabilityDriveEnv` is a batch of one.

The dynamics use road coordinates: s along the road, y to the left of its centre, both in metres, and drift, the speed
in y [m/s]. In the shapes, N is the number of environments and d the number of modalities.
"""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

CONDITIONS = ("sound", "black", "frozen", "noise")
"""
Conditions of a modality; all but the first are failures. A frozen modality is stuck at the frame of some other state,
so it is useless from the first step on; a black one shows zeros; noise has the standard deviation of sound frames.
"""

# Duration of a step [s]
DT = 0.2
# Half the width of the road [m]; beyond it the episode ends
HALF_WIDTH = 5.0
# Top speed of the car [m/s]
TOP_SPEED = 18.0
# Largest acceleration by throttle and by steering [m/s^2]
ALONG, ACROSS = 4.0, 4.0
# Decay rate of the drift [1/s]
DRAG = 1.0
# Amplitude [1/m] and wavelength [m] of the waves that add up to the curvature of the road
BENDS = np.array([[0.006, 190.0], [0.006, 110.0], [0.004, 61.0]])
# Mean [m/s], amplitude [m/s] and wavelength along the road [m] of the target speed
TARGET_SPEED = (10.0, 4.0, 160.0)
# Distances ahead [m] at which the state contains the curvature and the target speed
PREVIEW = np.array([0.0, 10.0, 20.0])
# Speed of the obstacle along the road [m/s]
OBSTACLE_SPEED = 5.0
# Amplitude [m] and angular frequency [1/s] with which the obstacle sways across the road
SWAY = (1.2, 0.4)
# Distance along and across the road [m] at which the cost of the obstacle has fallen to 1/e
CLEARANCE = (4.0, 1.6)
# Offset, drift, speed; three curvatures, three target speeds; distance, offset and drift of the obstacle
N_STATE = 12

# Values per frame
CHANNELS = 16
# Gain of the random layer: how far the state reaches into the nonlinear range of its tanh
GAIN = 1.2
# Standard deviation of the sensor noise
SENSOR_NOISE = 0.02
# Typical change of a value between frames. The second half of an observation is the change of each value, in octaves
# relative to this one: about 0 for sound modalities, low for frozen and black ones, high for noise.
TYPICAL_CHANGE = 0.05
# Octaves per unit of an observation
OCTAVES = 1.5
# Bound of an observation
MAX_VALUE = 3.0
# Standard deviation of the random state at which a modality freezes, about that of the true state
STUCK_STD = 0.5
# Standard deviation of a noise frame, about that of a sound one
FAILURE_NOISE = 0.5
# Mean number of steps between two draws of the conditions
MEAN_SEGMENT = 25
# Phases of the bends and of the target speed, start of the car, start of the obstacle
N_RESET_DRAWS = len(BENDS) + 1 + 3 + 3


class Encoding(NamedTuple):
    """
    Random layers through which the modalities observe the state.

    :param weight: Weights, (d, N_STATE, CHANNELS).
    :param bias: Biases, (d, CHANNELS).
    """

    weight: np.ndarray
    bias: np.ndarray

    @classmethod
    def draw(cls, n_modalities: int, n_blind: int, seed: int) -> "Encoding":
        """
        Draw the layers.

        :param n_modalities: Number of modalities d.
        :param n_blind: Number of directions of the state that each modality does not observe.
        :param seed: Seed of the draw.
        """
        rng = np.random.default_rng(seed)
        directions = np.linalg.qr(rng.normal(size=(N_STATE, N_STATE))).Q.T
        weight = rng.normal(size=(n_modalities, N_STATE, CHANNELS)) * GAIN / np.sqrt(N_STATE - n_blind)
        for i in range(n_modalities):
            blind = directions[np.arange(n_blind * i, n_blind * (i + 1)) % N_STATE]
            weight[i] -= blind.T @ (blind @ weight[i])
        return cls(weight, 0.3 * rng.normal(size=(n_modalities, CHANNELS)))

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """
        Return the frames of states.

        :param state: States, (N, N_STATE).
        :return: Frames, (N, d, CHANNELS).
        """
        # A sum instead of a matrix product, whose rounding would depend on N
        frames: np.ndarray = np.tanh((state[:, None, :, None] * self.weight).sum(axis=2) + self.bias)
        return frames


class DriveBatch:
    """
    A batch of N drives.

    :param num_envs: Number of environments N.
    :param n_modalities: Number of modalities d, 2 to 6.
    :param corruption: Probability that a modality fails in a segment. If all would fail, one is spared.
    :param failure: (modality, condition), e.g. ``(0, "black")``: this modality is always in this condition, and at
        least one other is sound.
    :param max_episode_steps: Steps after which an episode is truncated.
    :param n_blind: Number of directions of the 12-dimensional state that a modality does not observe, 0 to 11;
        different ones for each modality as far as possible. With 2, any two of three modalities together observe the
        whole state; with 8, each of three observes a different part.
    :param encoding_seed: Seed of the random layers, which belong to the task and not to the episode.
    :raises ValueError: If an option is out of range.
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
        self.stuck = np.zeros((num_envs, n_modalities, CHANNELS))  # frames of frozen modalities
        self.frames = np.zeros((num_envs, n_modalities, 2 * CHANNELS), np.float32)  # values and their changes

    def reset(self, rows: np.ndarray) -> None:
        """
        Begin new episodes.

        :param rows: Environments to reset, int (n,).
        """
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
        Simulate one step.

        :param actions: Throttle and steering to the left in [-1, 1], (N, 2).
        :return: Rewards, terminated (the car left the road) and truncated (the time is up), (N,) each.
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
        pace = np.maximum(0, 1 - np.abs(self.speed - self.target_speed(self.s)) / 6)
        rewards = self.speed / TARGET_SPEED[0] * pace * (1 - (self.y / HALF_WIDTH) ** 2) - nearness
        left_road = np.abs(self.y) > HALF_WIDTH
        rewards = np.where(left_road, 0.0, rewards)
        self._sense(np.arange(self.num_envs))
        return rewards, left_road, ~left_road & (self.steps >= self.max_episode_steps)

    def _move_obstacle(self) -> None:
        """Move the obstacle. Once it has fallen behind, the next one appears ahead."""
        # Draw the same number in every step, so that the stream does not depend on the obstacle
        place, lane = np.stack([rng.random(2) for rng in self.rngs], axis=1)
        self.obstacle[:, 0] += DT * OBSTACLE_SPEED
        behind = self.obstacle[:, 0] < self.s - 10
        self.obstacle[:, 0] = np.where(behind, self.s + 40 + 30 * place, self.obstacle[:, 0])
        self.obstacle[:, 1] = np.where(behind, 5 * lane - 2.5, self.obstacle[:, 1])

    def curvature(self, s: np.ndarray) -> np.ndarray:
        """
        Return the curvature of the road [1/m], positive to the left, (N,).

        :param s: Positions along the road [m], (N,).
        """
        waves = BENDS[:, 0] * np.sin(2 * np.pi * s[:, None] / BENDS[:, 1] + self.phases[:, :-1])
        curvature: np.ndarray = waves.sum(axis=1)
        return curvature

    def target_speed(self, s: np.ndarray) -> np.ndarray:
        """
        Return the target speed [m/s], (N,).

        :param s: Positions along the road [m], (N,).
        """
        mean, amplitude, wavelength = TARGET_SPEED
        speed: np.ndarray = mean + amplitude * np.sin(2 * np.pi * s / wavelength + self.phases[:, -1])
        return speed

    def obstacle_position(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance along and offset across the road [m], relative to the car, and drift [m/s], (N,) each."""
        amplitude, frequency = SWAY
        phase = frequency * DT * self.steps + self.obstacle[:, 2]
        offset = self.obstacle[:, 1] + amplitude * np.sin(phase) - self.y
        return self.obstacle[:, 0] - self.s, offset, amplitude * frequency * np.cos(phase)

    def state(self) -> np.ndarray:
        """Return the state, scaled to values of about 1, (N, N_STATE)."""
        mean, amplitude, _ = TARGET_SPEED
        distance, offset, drift = self.obstacle_position()
        columns = [self.y / HALF_WIDTH, self.drift / 2, (self.speed - mean) / 4]
        columns += [100 * self.curvature(self.s + ahead) for ahead in PREVIEW]
        columns += [(self.target_speed(self.s + ahead) - mean) / amplitude for ahead in PREVIEW]
        columns += [np.clip(distance / 20, -1, 2), np.clip(offset / 4, -2, 2), 2 * drift]
        return np.stack(columns, axis=1)

    def _sense(self, rows: np.ndarray, first: bool = False) -> None:
        """Draw conditions and make the next frames. Either all of these environments begin an episode, or none."""
        d = self.n_modalities
        uniform = np.stack([self.rngs[row].random(2 + 2 * d) for row in rows])
        normal = np.stack([self.rngs[row].standard_normal((d, CHANNELS)) for row in rows])
        changes = first | (uniform[:, 0] < 1 / MEAN_SEGMENT)
        self.condition[rows] = np.where(changes[:, None], self._draw_conditions(uniform[:, 1:]), self.condition[rows])
        elsewhere = np.stack([self.rngs[row].standard_normal(N_STATE) for row in rows])
        sticks = np.repeat(changes[:, None], d, axis=1)
        if self.failure is not None:
            # A modality that is frozen for whole episodes does not change within them
            sticks[:, self.failure[0]] = first
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
        """Draw the conditions of new segments, int (n, d), from uniform numbers (n, 1 + 2 d)."""
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
        """Whether each modality is sound, bool (N, d)."""
        return np.equal(self.condition, 0)

    def observation(self) -> dict[str, np.ndarray]:
        """Return the values and their changes by modality, float32 (N, 2 * CHANNELS) each."""
        return {f"m{i}": self.frames[:, i].reshape(self.num_envs, -1).copy() for i in range(self.n_modalities)}

    def info(self, row: int) -> dict[str, Any]:
        """
        Return the info of one environment.

        :param row: Number of the environment.
        :return: ``reliable`` (bool (d,), whether each modality is sound), ``condition`` (its name), ``distance`` [m],
            ``speed`` [m/s] and ``offroad``.
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
    One drive with a Dict of vectors as observations.

    Observation: ``m0``, ``m1``, ..., float32 (32,) each: the 16 values of a frame and their changes. Action: throttle
    and
    steering to the left in [-1, 1]. Reward per step::

        v / 10 m/s * max(0, 1 - |v - v_target| / 6 m/s) * (1 - (y / 5 m)^2) - exp(-(dx / 4 m)^2 - (dy / 1.6 m)^2)

    where dx and dy are the distances to the obstacle along and across the road. Leaving the road terminates the episode
    with reward 0; 200 steps truncate it. A rule-based driver that knows the state gets a return of 179.

    ``info["reliable"]`` states which modalities are sound, for analysis; see :meth:`DriveBatch.info`.

    :param render_mode: Must be None; there is nothing to see.
    :param options: Options of :class:`DriveBatch`.
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
    if n_modalities not in range(2, 7):
        raise ValueError(f"n_modalities must be a whole number in 2..6, got {n_modalities!r}")
    if not 0 <= corruption <= 1:
        raise ValueError(f"corruption must be a probability in 0..1, got {corruption!r}")
    if not max_episode_steps >= 1:
        raise ValueError(f"max_episode_steps must be >= 1, got {max_episode_steps!r}")
    if n_blind not in range(N_STATE):
        raise ValueError(f"n_blind must be a whole number in 0..{N_STATE - 1}, got {n_blind!r}")
    if failure is not None and (
        len(failure) != 2 or failure[0] not in range(n_modalities) or failure[1] not in CONDITIONS[1:]
    ):
        raise ValueError(
            f"failure must be (modality, condition) with a modality in 0..{n_modalities - 1} and one of "
            f"{CONDITIONS[1:]}, got {failure!r}"
        )
