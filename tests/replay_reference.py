"""Random streams of transitions for the tests of replay buffers, and what a buffer must hold of them."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_have import ModalityReplayBuffer

Observation = dict[str, np.ndarray]
CaseType = TypeVar("CaseType")
# Channels of one frame of the image keys; every other key is a value
FRAMES = {"gray": 1, "pair": 2, "rgb": 3, "event": 5, "float_image": 2}
HEIGHT, WIDTH = 21, 20  # no smaller, or SB3 takes a stack of 20 channels for an image with channels last
VALUES: dict[str, spaces.Space[Any]] = {
    "vector": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    "vector64": spaces.Box(-np.inf, np.inf, (2,), np.float64),
    "discrete": spaces.Discrete(4),
    "multi_discrete": spaces.MultiDiscrete([3, 2]),
    "multi_binary": spaces.MultiBinary(2),
    "bool": spaces.Box(0, 1, (2,), np.bool_),
}
ACTIONS: dict[str, spaces.Space[Any]] = {
    "box": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "box64": spaces.Box(-1.0, 1.0, (2,), np.float64),
    "discrete": spaces.Discrete(3),
}
PADDINGS = ("zeros", "repeat", "arbitrary", "again")
# "cut" and "flagged" have no done; the latter has the time limit's flag all the same
ENDS = ("terminated", "truncated", "cut", "flagged")
# "jump": one next_obs continues nothing. "one key": so does one key of it. "skip": obs is not the last next_obs.
ODDITIES = ("none", "none", "none", "jump", "one key", "skip")


@dataclass(frozen=True)
class Episode:
    length: int
    end: str = "terminated"
    padding: str = "zeros"
    oddity: str = "none"


@dataclass
class Transition:
    obs: Observation
    next_obs: Observation
    action: np.ndarray
    reward: float
    done: bool
    timeout: bool


@dataclass
class Case:
    """
    A stream of transitions and the buffer that is to hold it.

    :param keys: names of ``FRAMES`` and ``VALUES``
    :param episodes: of each environment, over and over
    :param n_stack: of the buffer
    :param env_stack: frames that the environment stacks, where they differ
    :param buffer_size: transitions of each environment
    :param n_steps: transitions of each environment that are added
    :param reuse_arrays: whether every ``add`` gets the same arrays with new contents
    """

    keys: tuple[str, ...] = ("rgb",)
    episodes: tuple[tuple[Episode, ...], ...] = ((Episode(3),),)
    n_stack: int = 1
    env_stack: int = 1
    buffer_size: int = 10
    n_steps: int = 20
    seed: int = 0
    action: str = "box"
    handle_timeout_termination: bool = True
    reuse_arrays: bool = False
    checks: frozenset[int] = field(default_factory=frozenset)

    @property
    def n_envs(self) -> int:
        return len(self.episodes)

    @property
    def space(self) -> spaces.Dict:
        return spaces.Dict({key: self._space(key) for key in self.keys})

    def frame_channels(self, key: str) -> int:
        """Channels of a frame of the environment, such that the buffer's ``n_stack`` divides those of the stack."""
        return FRAMES[key] * (self.n_stack // math.gcd(self.n_stack, self.env_stack))

    def _space(self, key: str) -> spaces.Space[Any]:
        if key in VALUES:
            return VALUES[key]
        shape = (self.env_stack * self.frame_channels(key), HEIGHT, WIDTH)
        if key == "float_image":
            return spaces.Box(0.0, 1.0, shape, np.float32)
        return spaces.Box(0, 255, shape, np.uint8)

    def buffers(self, box: bool = False, **kwargs: Any) -> tuple[ReplayBuffer, ModalityReplayBuffer]:
        """
        SB3's buffer and ours.

        :param box: for the first key alone
        :param kwargs: of our buffer
        """
        space = self.space[self.keys[0]] if box else self.space
        shared: dict[str, Any] = {
            "device": "cpu",
            "n_envs": self.n_envs,
            "handle_timeout_termination": self.handle_timeout_termination,
        }
        size, action_space = self.buffer_size * self.n_envs, ACTIONS[self.action]
        theirs = ReplayBuffer if box else DictReplayBuffer
        return (
            theirs(size, space, action_space, **shared),  # type: ignore[arg-type]
            ModalityReplayBuffer(size, space, action_space, n_stack=self.n_stack, **shared, **kwargs),
        )

    def steps(self) -> Iterator[list[Transition]]:
        """A transition of every environment, ``n_steps`` times."""
        streams = [
            _Stream(self, episodes, np.random.default_rng((self.seed, index))).transitions()
            for index, episodes in enumerate(self.episodes)
        ]
        return itertools.islice(map(list, zip(*streams, strict=True)), self.n_steps)


class _Stream:
    """The transitions of one environment."""

    def __init__(self, case: Case, episodes: tuple[Episode, ...], rng: np.random.Generator):
        self.case, self.episodes, self.rng = case, episodes, rng
        self.space = case.space
        self.palette = {key: [self.frame(key) for _ in range(2)] for key in case.keys if key in FRAMES}
        self.first_obs: Observation | None = None

    def transitions(self) -> Iterator[Transition]:
        for episode in itertools.cycle(self.episodes):
            obs = self.first_obs = self.reset(episode.padding)
            odd_step = self.rng.integers(episode.length)
            for step in range(episode.length):
                next_obs = self.advance(obs)
                odd, over = step == odd_step, step == episode.length - 1
                if odd and episode.oddity == "jump":
                    next_obs = self.reset("arbitrary")
                if odd and episode.oddity == "one key":
                    key = self.case.keys[self.rng.integers(len(self.case.keys))]
                    next_obs = {**next_obs, key: self.reset("arbitrary")[key]}
                yield Transition(
                    obs,
                    next_obs,
                    self.action(),
                    float(self.rng.normal()),
                    done=over and episode.end in ("terminated", "truncated"),
                    timeout=over and episode.end in ("truncated", "flagged"),
                )
                obs = self.advance(next_obs) if odd and episode.oddity == "skip" else next_obs

    def reset(self, padding: str) -> Observation:
        if padding == "again" and self.first_obs is not None:
            return self.first_obs
        obs: Observation = {}
        for key in self.case.keys:
            if key in VALUES:
                obs[key] = self.value(key)
                continue
            frames = [self.frame(key) for _ in range(self.case.env_stack)]
            if padding == "zeros":
                frames[:-1] = [np.zeros_like(frame) for frame in frames[:-1]]
            elif padding == "repeat":
                frames[:-1] = [frames[-1]] * (len(frames) - 1)
            obs[key] = np.concatenate(frames)
        return obs

    def advance(self, obs: Observation) -> Observation:
        """One frame further, which often is one of the last ones, a frame seen long ago, or all zeros."""
        next_obs: Observation = {}
        for key, stack in obs.items():
            if key in VALUES:
                next_obs[key] = stack if self.rng.random() < 0.2 else self.value(key)
                continue
            channels = self.case.frame_channels(key)
            kind = self.rng.choice(["new", "zeros", "last", "oldest", "palette"], p=[0.4, 0.15, 0.15, 0.1, 0.2])
            frame = {
                "new": self.frame(key),
                "zeros": np.zeros_like(stack[:channels]),
                "last": stack[-channels:],
                "oldest": stack[:channels],
                "palette": self.palette[key][self.rng.integers(2)],
            }[kind]
            next_obs[key] = np.concatenate([stack[channels:], frame])
        return next_obs

    def frame(self, key: str) -> np.ndarray:
        shape = (self.case.frame_channels(key), HEIGHT, WIDTH)
        if key == "float_image":
            return self.rng.random(shape, dtype=np.float32)
        return self.rng.integers(0, 256, shape, dtype=np.uint8)

    def value(self, key: str) -> np.ndarray:
        space = VALUES[key]
        if np.issubdtype(space.dtype, np.floating):
            return self.rng.normal(size=space.shape).astype(space.dtype)
        n: Any = {"discrete": 4, "multi_discrete": [3, 2]}.get(key, 2)
        return np.asarray(self.rng.integers(0, n, space.shape)).astype(space.dtype)

    def action(self) -> np.ndarray:
        space = ACTIONS[self.case.action]
        if isinstance(space, spaces.Discrete):
            return np.asarray(self.rng.integers(3))
        return self.rng.uniform(-1, 1, space.shape).astype(space.dtype)


def batch(transitions: list[Transition], box: bool = False) -> dict[str, Any]:
    """The arguments of ``ReplayBuffer.add``, in arrays of their own."""

    def stacked(observations: list[Observation]) -> Any:
        together = {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
        return next(iter(together.values())) if box else together

    return {
        "obs": stacked([transition.obs for transition in transitions]),
        "next_obs": stacked([transition.next_obs for transition in transitions]),
        "action": np.stack([transition.action for transition in transitions]),
        "reward": np.array([transition.reward for transition in transitions]),
        "done": np.array([transition.done for transition in transitions]),
        "infos": [{"TimeLimit.truncated": True} if transition.timeout else {} for transition in transitions],
    }


class Feeder:
    """
    Adds to several buffers as an algorithm does; the arrays change after ``add``, as those of some wrappers do.

    :param reuse_arrays: whether every ``add`` gets the same arrays
    """

    def __init__(self, buffers: list[ReplayBuffer], reuse_arrays: bool = False, box: bool = False):
        self.buffers, self.box = buffers, box
        self.arrays: dict[int, dict[str, Any]] | None = {} if reuse_arrays else None

    def add(self, transitions: list[Transition]) -> None:
        for index, buffer in enumerate(self.buffers):
            arguments = batch(transitions, self.box)
            if self.arrays is not None:
                arguments = _overwrite(self.arrays.setdefault(index, arguments), arguments)
            buffer.add(**arguments)
            if self.arrays is None:
                _spoil(arguments)


def _overwrite(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    for name, value in new.items():
        if isinstance(value, dict):
            _overwrite(old[name], value)
        elif isinstance(value, np.ndarray):
            old[name].reshape(value.shape)[...] = value  # SB3 may have reshaped it
        else:
            old[name] = value
    return old


def _spoil(arguments: dict[str, Any]) -> None:
    for value in arguments.values():
        if isinstance(value, dict):
            _spoil(value)
        elif isinstance(value, np.ndarray):
            value[...] = 1


def every_transition(buffer: ReplayBuffer, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """
    Indices for ``_get_samples`` such that, with numpy's seed ``seed``, every transition of every environment is met.

    :return: positions and the environments that the seed draws for them, (N,) each
    """
    size = buffer.size()
    for n_draws in itertools.count(2 * size * buffer.n_envs + 8, 8):
        np.random.seed(seed)
        env_indices = np.random.randint(0, high=buffer.n_envs, size=(n_draws,))
        if np.bincount(env_indices, minlength=buffer.n_envs).min() >= size:
            break
    positions = np.empty_like(env_indices)
    for env_index in range(buffer.n_envs):
        met = env_indices == env_index
        positions[met] = np.arange(met.sum()) % size
    return positions, env_indices


def held(buffer: ReplayBuffer, env: VecNormalize | None = None, seed: int = 0) -> Any:
    """Samples of every transition in the buffer, in the order of :func:`every_transition`."""
    positions, _ = every_transition(buffer, seed)
    np.random.seed(seed)
    return buffer._get_samples(positions, env=env)


def assert_same_samples(expected: Any, samples: Any, rtol: float = 0.0) -> None:
    """
    Two batches are of one type and equal in every field: shapes, types, bits, order of the keys.

    :param rtol: tolerance for rewards and discounts, which may be sums in another order
    """
    assert type(samples) is type(expected)
    for name, value in expected._asdict().items():
        other = getattr(samples, name)
        if isinstance(value, dict):
            assert list(other) == list(value), name
            for key, tensor in value.items():
                _assert_same(tensor, other[key], f"{name}[{key}]", 0.0)
        elif value is None:
            assert other is None, name
        else:
            _assert_same(value, other, name, rtol if name in ("rewards", "discounts") else 0.0)


def _assert_same(expected: th.Tensor, tensor: th.Tensor, name: str, rtol: float) -> None:
    assert (tensor.dtype, tensor.shape) == (expected.dtype, expected.shape), name
    if rtol == 0.0:
        assert th.equal(expected, tensor), name
    else:
        assert th.allclose(expected, tensor, rtol=rtol, atol=rtol), name


@st.composite
def cases(
    draw: st.DrawFn,
    keys: tuple[str, ...] = (*FRAMES, *VALUES),
    max_keys: int = 3,
    oddities: tuple[str, ...] = ODDITIES,
    ends: tuple[str, ...] = ENDS,
    foreign_stacks: bool = True,
    max_buffer_size: int = 20,
) -> Case:
    """Streams over 1 to 3 environments, and buffers that wrap several times, once or not at all."""
    episode = st.builds(
        Episode,
        st.integers(1, 8),
        st.sampled_from(ends),
        st.sampled_from(PADDINGS),
        st.sampled_from(oddities),
    )
    n_stack = draw(st.integers(1, 4))
    foreign = foreign_stacks and draw(st.integers(0, 4)) == 4
    buffer_size = draw(st.integers(1, max_buffer_size))
    n_steps = draw(st.integers(1, 3 * buffer_size + 8))
    return Case(
        keys=tuple(draw(st.lists(st.sampled_from(keys), min_size=1, max_size=max_keys, unique=True))),
        episodes=tuple(tuple(draw(st.lists(episode, min_size=1, max_size=5))) for _ in range(draw(st.integers(1, 3)))),
        n_stack=n_stack,
        env_stack=draw(st.integers(1, 4)) if foreign else n_stack,
        buffer_size=buffer_size,
        n_steps=n_steps,
        seed=draw(st.integers(0, 2**16)),
        action=draw(st.sampled_from(sorted(ACTIONS))),
        handle_timeout_termination=draw(st.booleans()),
        reuse_arrays=draw(st.booleans()),
        checks=frozenset(draw(st.lists(st.integers(1, n_steps), max_size=2))) | {n_steps},
    )


def property_of(strategy: st.SearchStrategy[CaseType], n_cases: int) -> Callable[[Callable[[CaseType], None]], Any]:
    """Makes a test that holds for ``n_cases`` cases, the same ones in every run, and asserts that so many ran."""

    def decorate(check: Callable[[CaseType], None]) -> Callable[[], None]:
        ran = 0

        def counted(case: CaseType) -> None:
            nonlocal ran
            check(case)
            ran += 1

        # Named after the property, because a fixed sequence is drawn from the name
        counted.__name__, counted.__qualname__ = check.__name__, check.__qualname__
        fixed = settings(
            max_examples=n_cases,
            derandomize=True,
            deadline=None,
            database=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
        )
        run = fixed(given(strategy)(counted))

        def test() -> None:
            nonlocal ran
            ran = 0
            run()
            assert ran >= n_cases, f"{ran} of {n_cases} cases ran"

        test.__name__, test.__doc__ = check.__name__, check.__doc__
        test.n_cases = n_cases  # type: ignore[attr-defined]
        return test

    return decorate


def n_step_reference(
    history: list[Transition], start: int, n_steps: int, gamma: float, handle_timeouts: bool, cuts: frozenset[int]
) -> tuple[float, Transition, float, float]:
    """
    The n-step return from ``history[start]``, by a loop: sum of gamma^i r_i until the episode or the stream ends.

    :param history: of one environment, up to the last written transition
    :param cuts: indices of transitions after which the stream was cut by hand
    :return: return, last transition, its done (0 where it is a timeout), gamma to the number of its steps
    """
    total = 0.0
    for i in range(n_steps):
        last = history[start + i]
        total += gamma**i * last.reward
        timeout = last.timeout and handle_timeouts
        if last.done or timeout or start + i == len(history) - 1 or start + i in cuts:
            break
        following = history[start + i + 1].obs
        if any(not np.array_equal(last.next_obs[key], following[key]) for key in following):
            break
    return total, last, float(last.done and not timeout), gamma ** (i + 1)
