"""ModalityReplayBuffer holds what SB3's buffers hold, whatever is added: properties of random streams."""

import copy
import pickle
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors
from gymnasium import spaces
from hypothesis import strategies as st
from replay_reference import (
    FRAMES,
    HEIGHT,
    VALUES,
    WIDTH,
    Case,
    Episode,
    Feeder,
    Transition,
    assert_same_samples,
    batch,
    cases,
    every_transition,
    held,
    n_step_reference,
    property_of,
)
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_have import ModalityReplayBuffer

GAMMAS = (0.5, 0.9, 0.99)
# Without the time limit's flag beside no done, and obs always the last next_obs or a reset's after a done
PROPER: dict[str, Any] = {"oddities": ("none",), "ends": ("terminated", "truncated")}


# -- One step


@property_of(cases(), 800)
def test_dict_observations(case: Case) -> None:
    theirs, ours = case.buffers()
    feeder = Feeder([theirs, ours], case.reuse_arrays)
    for step, transitions in enumerate(case.steps(), start=1):
        feeder.add(transitions)
        assert (ours.size(), ours.pos, ours.full) == (theirs.size(), theirs.pos, theirs.full)
        if step in case.checks:
            assert_same_samples(held(theirs, seed=step), held(ours, seed=step))


@property_of(cases(max_keys=1), 250)
def test_box_observations(case: Case) -> None:
    theirs, ours = case.buffers(box=True)
    feeder = Feeder([theirs, ours], case.reuse_arrays, box=True)
    for step, transitions in enumerate(case.steps(), start=1):
        feeder.add(transitions)
        if step in case.checks:
            assert_same_samples(held(theirs, seed=step), held(ours, seed=step))


@property_of(st.tuples(cases(), st.integers(1, 40), st.integers(0, 2**16)), 150)
def test_sample_draws_as_sb3_does(drawn: tuple[Case, int, int]) -> None:
    case, batch_size, seed = drawn
    theirs, ours = case.buffers()
    feeder = Feeder([theirs, ours])
    for transitions in case.steps():
        feeder.add(transitions)
    np.random.seed(seed)
    expected, draw_after = theirs.sample(batch_size), np.random.random()
    np.random.seed(seed)
    assert_same_samples(expected, ours.sample(batch_size))
    assert np.random.random() == draw_after


@property_of(
    st.tuples(
        cases(), st.sampled_from(["pickle", "deepcopy", "truncate", "reset"]), st.sampled_from(["memory", "device"])
    ),
    250,
)
def test_interrupted_streams(drawn: tuple[Case, str, str]) -> None:
    """Saved and loaded, copied, cut off by hand or emptied in the middle, with either storage."""
    case, interruption, storage = drawn
    theirs, ours = case.buffers(storage=storage)
    feeder = Feeder([theirs, ours], case.reuse_arrays)
    for step, transitions in enumerate(case.steps(), start=1):
        feeder.add(transitions)
        if step not in case.checks:
            continue
        if interruption == "pickle":
            ours = pickle.loads(pickle.dumps(ours))
        elif interruption == "deepcopy":
            ours = copy.deepcopy(ours)
        elif interruption == "truncate":
            ours.truncate_last_trajectory()
        elif step < case.n_steps:
            theirs.reset()
            ours.reset()
            assert ours.size() == 0
            continue
        feeder.buffers = [theirs, ours]
        assert_same_samples(held(theirs, seed=step), held(ours, seed=step))


# -- n steps


@property_of(st.tuples(cases(), st.integers(2, 6), st.sampled_from(GAMMAS), st.sampled_from(["none", "cut"])), 300)
def test_n_step_returns(drawn: tuple[Case, int, float, str]) -> None:
    case, n_steps, gamma, interruption = drawn
    _, ours = case.buffers(n_steps=n_steps, gamma=gamma)
    feeder = Feeder([ours], case.reuse_arrays)
    history: list[list[Transition]] = [[] for _ in range(case.n_envs)]
    cuts: set[int] = set()
    for step, transitions in enumerate(case.steps(), start=1):
        feeder.add(transitions)
        for of_env, transition in zip(history, transitions, strict=True):
            of_env.append(transition)
        if step not in case.checks:
            continue
        if interruption == "cut":
            ours.truncate_last_trajectory()
            cuts.add(step - 1)
        assert_n_step_returns(case, ours, history, n_steps, gamma, frozenset(cuts))


def assert_n_step_returns(
    case: Case,
    buffer: ModalityReplayBuffer,
    history: list[list[Transition]],
    n_steps: int,
    gamma: float,
    cuts: frozenset[int],
) -> None:
    positions, env_indices = every_transition(buffer)
    samples, n_added, size = held(buffer), len(history[0]), buffer.size()
    starts = [n_added - 1 - (n_added - 1 - position) % buffer.buffer_size for position in positions]
    expected = [
        n_step_reference(history[env_index], start, n_steps, gamma, case.handle_timeout_termination, cuts)
        for start, env_index in zip(starts, env_indices, strict=True)
    ]
    assert min(starts) == n_added - size
    returns, last, dones, discounts = zip(*expected, strict=True)
    for tensor, numbers in [(samples.rewards, returns), (samples.dones, dones), (samples.discounts, discounts)]:
        assert (tensor.dtype, tensor.shape) == (th.float32, (len(positions), 1))
        np.testing.assert_allclose(tensor.squeeze(1).numpy(), numbers, rtol=1e-5, atol=1e-5)
    for key in case.keys:
        obs = [history[env_index][start].obs[key] for start, env_index in zip(starts, env_indices, strict=True)]
        for tensor, arrays in [
            (samples.observations[key], obs),
            (samples.next_observations[key], [transition.next_obs[key] for transition in last]),
        ]:
            np.testing.assert_array_equal(tensor.numpy().reshape(len(obs), -1), np.reshape(arrays, (len(obs), -1)))


@property_of(
    st.tuples(cases(max_keys=1, foreign_stacks=False, **PROPER), st.integers(2, 6), st.sampled_from(GAMMAS)), 250
)
def test_n_step_returns_are_those_of_sb3(drawn: tuple[Case, int, float]) -> None:
    case, n_steps, gamma = drawn
    _, ours = case.buffers(box=True, n_steps=n_steps, gamma=gamma)
    theirs = NStepReplayBuffer(
        case.buffer_size * case.n_envs,
        ours.observation_space,
        ours.action_space,
        device="cpu",
        n_envs=case.n_envs,
        handle_timeout_termination=case.handle_timeout_termination,
        n_steps=n_steps,
        gamma=gamma,
    )
    feeder = Feeder([theirs, ours], box=True)
    for step, transitions in enumerate(case.steps(), start=1):
        feeder.add(transitions)
        if step in case.checks:
            assert_same_samples(held(theirs, seed=step), held(ours, seed=step), rtol=1e-6)


def test_one_step_has_no_discounts() -> None:
    case = Case()
    _, ours = case.buffers(n_steps=1, gamma=0.5)
    Feeder([ours]).add(next(case.steps()))
    assert ours.sample(2).discounts is None


# -- VecNormalize


def normalizer(space: spaces.Space[Any], **kwargs: Any) -> VecNormalize:
    """With statistics far from 0 and 1."""
    env = VecNormalize(DummyVecEnv([lambda: RandomSensors(space)]), gamma=0.9, **kwargs)
    rng = np.random.default_rng(1)
    if env.norm_obs:
        for running in env.obs_rms.values() if isinstance(env.obs_rms, dict) else [env.obs_rms]:
            running.update(rng.normal(3.0, 2.0, (50, *np.shape(running.mean))))
    env.ret_rms.update(rng.normal(1.0, 4.0, 50))
    return env


@property_of(
    st.tuples(
        cases(keys=("rgb", "event", "float_image", "discrete")), st.booleans(), st.booleans(), st.sampled_from([1, 3])
    ),
    150,
)
def test_vec_normalize(drawn: tuple[Case, bool, bool, int]) -> None:
    """Vectors and rewards are normalised at sampling, time after time from the same originals; images are not."""
    case, norm_obs, norm_reward, n_steps = drawn
    case = replace(case, keys=(*case.keys, "vector"))
    theirs, ours = case.buffers(n_steps=n_steps, gamma=0.9)
    feeder = Feeder([theirs, ours])
    for transitions in case.steps():
        feeder.add(transitions)
    env = normalizer(
        case.space, norm_obs=norm_obs, norm_reward=norm_reward, norm_obs_keys=["vector"] if norm_obs else None
    )
    held(ours, env)
    expected, samples, originals = held(theirs, env), held(ours, env), held(theirs)
    if n_steps == 1:
        assert_same_samples(expected, samples)
    assert samples.observations["vector"].equal(expected.observations["vector"])
    assert norm_obs != samples.observations["vector"].equal(originals.observations["vector"])
    for key in case.keys[:-1]:
        assert samples.observations[key].equal(originals.observations[key])


@property_of(
    st.tuples(cases(keys=("vector",), max_keys=1, foreign_stacks=False, **PROPER), st.sampled_from([1, 3])), 60
)
def test_vec_normalize_of_a_box(drawn: tuple[Case, int]) -> None:
    case, n_steps = drawn
    theirs, ours = case.buffers(box=True, n_steps=n_steps, gamma=0.9)
    if n_steps > 1:
        size, space = case.buffer_size * case.n_envs, ours.observation_space
        theirs = NStepReplayBuffer(size, space, ours.action_space, "cpu", case.n_envs, n_steps=n_steps, gamma=0.9)
        theirs.handle_timeout_termination = case.handle_timeout_termination
    feeder = Feeder([theirs, ours], box=True)
    for transitions in case.steps():
        feeder.add(transitions)
    env = normalizer(ours.observation_space)
    assert_same_samples(held(theirs, env), held(ours, env), rtol=1e-6)


def test_enough_cases() -> None:
    assert sum(getattr(test, "n_cases", 0) for test in globals().values()) >= 2000


# -- Chosen streams, so that each trap is met for certain


@pytest.mark.parametrize("storage", ["memory", "mmap", "device"])
@pytest.mark.parametrize("padding", ["zeros", "repeat", "arbitrary", "again"])
@pytest.mark.parametrize("n_stack", [1, 2, 4])
def test_paddings_and_storages(n_stack: int, padding: str, storage: str, tmp_path: Path) -> None:
    case = Case(
        keys=(*FRAMES, *VALUES),
        episodes=((Episode(1, "terminated", padding), Episode(5, "truncated", padding), Episode(2, "cut", padding)),)
        * 2,
        n_stack=n_stack,
        env_stack=n_stack,
        buffer_size=7,
        n_steps=40,
    )
    theirs, ours = case.buffers(storage=storage, mmap_dir=str(tmp_path) if storage == "mmap" else None)
    feeder = Feeder([theirs, ours])
    for transitions in case.steps():
        feeder.add(transitions)
        assert_same_samples(held(theirs), held(ours))


def test_a_frame_of_zeros_in_an_episode() -> None:
    """It looks like padding, and is not."""
    case = Case(keys=("gray",), n_stack=3, env_stack=3)
    theirs, ours = case.buffers()
    feeder = Feeder([theirs, ours])
    frames = np.zeros((12, 1, HEIGHT, WIDTH), np.uint8)
    frames[[2, 3, 7]] = np.array([1, 1, 2], np.uint8).reshape(3, 1, 1, 1)
    stacks = [np.concatenate(frames[start : start + 3]) for start in range(10)]
    for obs, next_obs in pairwise(stacks):
        feeder.add([Transition({"gray": obs}, {"gray": next_obs}, np.zeros(2), 0.0, False, False)])
        assert_same_samples(held(theirs), held(ours))


@pytest.mark.parametrize("n_steps", [1, 3])
def test_an_n_step_return_across_the_end_of_the_arrays(n_steps: int) -> None:
    """One long episode over a full buffer: returns run from its last row to its first, not past the newest."""
    case = Case(keys=("rgb", "vector"), episodes=((Episode(1000),),), n_stack=2, env_stack=2, buffer_size=5, n_steps=13)
    _, ours = case.buffers(n_steps=n_steps, gamma=0.5)
    history: list[list[Transition]] = [[]]
    for transitions in case.steps():
        batched = batch(transitions)
        ours.add(**batched)
        history[0] += transitions
    assert ours.pos == 3
    np.random.seed(0)
    samples = ours._get_samples(np.array([4, 0, 1, 2]))
    expected = [n_step_reference(history[0], start, n_steps, 0.5, True, frozenset()) for start in (9, 10, 11, 12)]
    if n_steps == 3:
        assert [discount for *_, discount in expected] == [0.125, 0.125, 0.25, 0.5]
        assert samples.discounts is not None
        assert samples.discounts.squeeze(1).tolist() == [0.125, 0.125, 0.25, 0.5]
    np.testing.assert_allclose(samples.rewards.squeeze(1), [total for total, *_ in expected], rtol=1e-6)


def test_samples_are_copies() -> None:
    """Writing into a batch leaves the buffer as it was, and later additions leave the batch as it was."""
    case = Case(keys=("rgb", "vector"), episodes=((Episode(4),),), n_stack=2, env_stack=2, buffer_size=4, n_steps=30)
    _, ours = case.buffers()
    steps = case.steps()
    for _ in range(6):
        ours.add(**batch(next(steps)))
    first, again = held(ours), held(ours)
    kept = copy.deepcopy(again)
    for tensor in [*first.observations.values(), *first.next_observations.values(), first.actions, first.rewards]:
        tensor.fill_(7)
    assert_same_samples(kept, held(ours))
    for transitions in steps:
        ours.add(**batch(transitions))
    assert_same_samples(kept, again)


@pytest.mark.parametrize(
    "dtype", [np.uint8, np.int8, np.uint16, np.int32, np.int64, np.float16, np.float32, np.float64]
)
def test_types_of_arrays(dtype: Any) -> None:
    """Any number that SB3's buffer takes, from arrays of any layout: views, mirrored, transposed, of another type."""
    shape, n_stack = (6, 16, 16), 2
    space = spaces.Dict({"image": spaces.Box(0, 100, shape, dtype), "vector": spaces.Box(0, 100, (3,), dtype)})
    arguments: list[Any] = [10, space, spaces.Box(-1.0, 1.0, (2,), np.float32), "cpu", 2]
    theirs = DictReplayBuffer(*arguments)
    ours: ModalityReplayBuffer = partial(ModalityReplayBuffer, n_stack=n_stack)(*arguments)
    rng = np.random.default_rng(0)

    def observation(step: int) -> dict[str, np.ndarray]:
        image, vector = rng.integers(0, 100, (2, 16, 16, 6)), rng.integers(0, 100, (2, 3)).astype(np.float64)
        layouts = [
            image.transpose(0, 3, 1, 2),
            image.transpose(0, 3, 2, 1).astype(dtype),
            image.reshape(2, *shape)[:, ::-1],
        ]
        mirrored = layouts[step % 3][..., ::-1]
        return {"vector": vector[:, ::-1], "image": mirrored, "not in the space": vector}

    obs = observation(0)
    for step in range(1, 12):
        next_obs = observation(step)
        for buffer in (theirs, ours):
            buffer.add(obs, next_obs, np.zeros((2, 2)), np.zeros(2), np.zeros(2), [{}, {}])
        obs = next_obs
        assert_same_samples(held(theirs), held(ours))


@pytest.mark.parametrize(
    "shape,n_stack",
    [((20, 6, 6), 4), ((20, 6, 7), 4), ((6, 6, 20), 2), ((9, 4, 16), 3), ((2, 3, 4, 5), 2), ((3, 3), 3), ((3,), 3)],
)
def test_shapes_that_are_hardly_images(shape: tuple[int, ...], n_stack: int) -> None:
    """More channels than rows, channels last, more or fewer dimensions: held all the same, without a warning."""
    space = spaces.Dict(
        {"array": spaces.Box(0, 255, shape, np.uint8), "rgb": spaces.Box(0, 255, (12, 16, 16), np.uint8)}
    )
    arguments: list[Any] = [8, space, spaces.Box(-1.0, 1.0, (2,), np.float32), "cpu"]
    theirs = DictReplayBuffer(*arguments)
    ours: ModalityReplayBuffer = partial(ModalityReplayBuffer, n_stack=n_stack)(*arguments)
    rng = np.random.default_rng(0)

    def observation() -> dict[str, np.ndarray]:
        return {key: rng.integers(0, 3, (1, *box.shape)).astype(np.uint8) for key, box in space.items()}  # type: ignore[misc]

    obs = observation()
    for _ in range(11):
        next_obs = observation()
        for buffer in (theirs, ours):
            buffer.add(obs, next_obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
        obs = next_obs
    assert_same_samples(held(theirs), held(ours))


def test_numbers_that_are_none() -> None:
    """NaN equals nothing, itself included: such stacks are stored anew."""
    case = Case(keys=("vector", "float_image"), n_stack=2, env_stack=2, buffer_size=6)
    theirs, ours = case.buffers()
    for transitions in case.steps():
        for buffer in (theirs, ours):
            arguments = batch(transitions)
            arguments["obs"]["vector"][:, 0] = arguments["next_obs"]["vector"][:, 0] = np.nan
            arguments["next_obs"]["float_image"][:, -1] = np.inf
            buffer.add(**arguments)
    for expected, ours_samples in [(held(theirs), held(ours))]:
        np.testing.assert_array_equal(expected.observations["vector"], ours_samples.observations["vector"])
        np.testing.assert_array_equal(expected.next_observations["vector"], ours_samples.next_observations["vector"])
        assert ours_samples.next_observations["float_image"].equal(expected.next_observations["float_image"])
