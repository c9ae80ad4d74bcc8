"""ReliabilityDrive-v0: what the modalities show, when they fail, and that a batch equals single environments."""

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.reliability_vec_env import ReliabilityDriveVecEnv
from sb3_have.envs import reliability_drive
from sb3_have.envs.reliability_drive import (
    CHANNELS,
    CONDITIONS,
    FAILURE_NOISE,
    MAX_VALUE,
    MEAN_SEGMENT,
    N_STATE,
    OCTAVES,
    SENSOR_NOISE,
    TYPICAL_CHANGE,
    DriveBatch,
    Encoding,
    ReliabilityDriveEnv,
)


def drive(batch: DriveBatch, n_steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Frames (T, N, d, CHANNELS) and conditions (T, N, d) of a drive in the middle of the road."""
    rng = np.random.default_rng(seed)
    batch.rngs = [np.random.default_rng(seed + i) for i in range(batch.num_envs)]
    batch.reset(np.arange(batch.num_envs))
    frames, conditions = [], []
    for _ in range(n_steps):
        batch.y[:], batch.drift[:] = 0.0, 0.0
        batch.step(rng.uniform(-1, 1, (batch.num_envs, 2)))
        frames.append(batch.frames[:, :, :CHANNELS].copy())
        conditions.append(batch.condition.copy())
    return np.stack(frames), np.stack(conditions)


@pytest.mark.parametrize("n_modalities", [2, 3, 6])
def test_is_an_environment(n_modalities: int) -> None:
    env = gym.make("ReliabilityDrive-v0", n_modalities=n_modalities)
    check_env(env.unwrapped, skip_render_check=True)
    check_env_sb3(env.unwrapped)
    assert list(env.observation_space.spaces) == [f"m{i}" for i in range(n_modalities)]  # type: ignore[attr-defined]


def test_needs_no_torch() -> None:
    file = Path(reliability_drive.__file__)
    code = f"import sys, runpy; runpy.run_path({str(file)!r}); sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("options", [{}, {"n_modalities": 5, "corruption": 0.9}, {"failure": (1, "frozen")}])
def test_batch_equals_single_environments(options: dict[str, Any]) -> None:
    """Step for step and bit for bit, over the ends of episodes."""
    n = 3
    batch = ReliabilityDriveVecEnv(n, max_episode_steps=40, **options)
    singles = DummyVecEnv([lambda: ReliabilityDriveEnv(max_episode_steps=40, **options)] * n)
    rng = np.random.default_rng(0)
    ended = {"terminated": 0, "truncated": 0}
    for env in (batch, singles):
        env.seed(7)
    _assert_equal(batch.reset(), singles.reset())
    for _ in range(150):
        actions = rng.uniform([-1, -0.7], [1, 0.7], (n, 2)).astype(np.float32)
        got, expected = batch.step(actions), singles.step(actions)
        for one, other in zip(got, expected, strict=True):
            _assert_equal(one, other)
        for done, info in zip(got[2], got[3], strict=True):
            if done:
                ended["truncated" if info["TimeLimit.truncated"] else "terminated"] += 1
    assert min(ended.values()) > 0
    _assert_equal(batch.reset_infos, singles.reset_infos)


def _assert_equal(one: Any, other: Any) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            _assert_equal(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        for a, b in zip(one, other, strict=True):
            _assert_equal(a, b)
    else:
        np.testing.assert_array_equal(one, other)


def test_seed_decides_everything() -> None:
    def rollout(seed: int) -> list[np.ndarray]:
        env = ReliabilityDriveEnv()
        observation, _ = env.reset(seed=seed)
        rows = [np.concatenate(list(observation.values()))]
        for _ in range(30):
            observation, reward, terminated, _, _ = env.step(np.array([0.1, 0.0]))
            rows.append(np.append(np.concatenate(list(observation.values())), reward))
            if terminated:
                observation, _ = env.reset()
        return rows

    first, again, other = rollout(3), rollout(3), rollout(4)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize("n_modalities", [2, 3, 6])
def test_one_modality_is_not_enough_and_two_are(n_modalities: int) -> None:
    """Each is blind to two directions of the state; any two of them see all."""
    weight = DriveBatch(1, n_modalities=n_modalities).encoding.weight
    assert weight.shape == (n_modalities, N_STATE, CHANNELS)
    for i, j in itertools.combinations(range(n_modalities), 2):
        assert np.linalg.matrix_rank(weight[i]) == N_STATE - 2
        singular = np.linalg.svd(np.concatenate([weight[i], weight[j]], axis=1))[1]
        assert singular[-1] > 0.1 * singular[0]


def test_modalities_may_each_show_a_part_of_their_own() -> None:
    weight = Encoding.draw(3, n_blind=8, seed=0).weight
    assert [np.linalg.matrix_rank(each) for each in weight] == [4, 4, 4]
    for i, j in itertools.combinations(range(3), 2):
        assert np.linalg.matrix_rank(np.concatenate([weight[i], weight[j]], axis=1)) == 8
    assert np.linalg.matrix_rank(np.concatenate(list(weight), axis=1)) == N_STATE


def test_encoding_belongs_to_the_task() -> None:
    state = np.ones((1, N_STATE))
    batches = [DriveBatch(1), DriveBatch(1), DriveBatch(1, encoding_seed=1)]
    frames = [batch.encoding(state) for batch in batches]
    assert np.array_equal(frames[0], frames[1]) and not np.allclose(frames[0], frames[2])


def test_conditions_are_what_they_are_called() -> None:
    batch = DriveBatch(8)
    frames, conditions = drive(batch, 300)
    code = {name: i for i, name in enumerate(CONDITIONS)}
    now, before = frames[1:], frames[:-1]
    assert (now[conditions[1:] == code["black"]] == 0).all()
    frozen = (conditions[1:] == code["frozen"]) & (conditions[:-1] == code["frozen"])
    assert (now == before).all(axis=-1)[frozen].mean() > 0.95  # but where a new segment has begun
    assert now[frozen].std() == pytest.approx(now[conditions[1:] == code["sound"]].std(), rel=0.25)  # it looks sound
    noise = now[conditions[1:] == code["noise"]]
    assert abs(noise.mean()) < 0.02 and noise.std() == pytest.approx(FAILURE_NOISE, rel=0.05)
    lag = np.corrcoef(noise[:, 0], noise[:, 1])[0, 1]
    assert abs(lag) < 0.1  # no structure between the channels
    sound = conditions[1:] == code["sound"]
    step = np.abs(now - before)[sound & (conditions[:-1] == code["sound"])]
    assert SENSOR_NOISE < step.mean() < 0.3 * FAILURE_NOISE  # it moves, but not as noise does


def test_sound_modalities_show_the_state() -> None:
    batch = DriveBatch(4, corruption=0.0)
    frames, conditions = drive(batch, 20)
    assert (conditions == 0).all()
    error = frames[-1] - batch.encoding(batch.state())
    assert error.std() == pytest.approx(SENSOR_NOISE, rel=0.2)


def test_segments() -> None:
    """At least one sound at any time, 25 steps on average, and the share that follows from the probability."""
    batch = DriveBatch(50, corruption=0.5)
    _, conditions = drive(batch, 600)
    sound = conditions == 0
    assert sound.any(axis=2).all()
    assert sound.mean() == pytest.approx(0.5 + 0.5**3 / 3, abs=0.02)
    # a new segment changes something unless it draws the same conditions, whose chance is the sum of squares
    codes = conditions @ 4 ** np.arange(3)
    chance = (np.unique(codes, return_counts=True)[1] / codes.size) ** 2
    changes = (codes[1:] != codes[:-1]).mean()
    assert changes == pytest.approx((1 - chance.sum()) / MEAN_SEGMENT, rel=0.08)
    kinds = np.bincount(conditions[~sound], minlength=4)[1:]
    assert (np.abs(kinds / kinds.sum() - 1 / 3) < 0.03).all()


@pytest.mark.parametrize("kind", CONDITIONS[1:])
@pytest.mark.parametrize("corruption", [0.0, 0.9])
def test_failure_of_whole_episodes(kind: str, corruption: float) -> None:
    env = ReliabilityDriveEnv(failure=(2, kind), corruption=corruption)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        first = observation["m2"][:CHANNELS]
        done = False
        while not done:
            assert info["condition"][2] == kind and info["reliable"][:2].any()
            if corruption == 0:
                assert info["reliable"].tolist() == [True, True, False]
            frame = observation["m2"][:CHANNELS]
            assert (frame == first).all() if kind == "frozen" else (frame != 0).any() == (kind == "noise")
            observation, _, terminated, truncated, info = env.step(np.zeros(2))
            done = terminated or truncated


def test_observation_is_a_frame_and_how_lively_it_is() -> None:
    env = ReliabilityDriveEnv(corruption=0.0)
    observation, _ = env.reset(seed=0)
    assert (observation["m0"][CHANNELS:] == 0).all()
    for _ in range(4):
        before = observation["m0"][:CHANNELS].astype(float)
        observation, *_ = env.step(np.array([1.0, 1.0]))
        octaves = np.log2(np.abs(observation["m0"][:CHANNELS] - before) / TYPICAL_CHANGE)
        np.testing.assert_allclose(
            observation["m0"][CHANNELS:], np.clip(octaves / OCTAVES, -MAX_VALUE, MAX_VALUE), atol=1e-3
        )


@pytest.mark.parametrize("kind,lively", [("black", -1), ("frozen", -1), ("noise", 1)])
def test_a_failed_modality_is_too_quiet_or_too_lively(kind: str, lively: int) -> None:
    """The changes of its values, the second half of its observation, reveal the failure."""
    means = []
    for failure in (None, (1, kind)):
        env = ReliabilityDriveEnv(corruption=0.0, failure=failure)
        env.reset(seed=0)
        means.append(np.mean([env.step(np.zeros(2))[0]["m1"][CHANNELS:].mean() for _ in range(12)]))
    assert lively * (means[1] - means[0]) > 1


def test_failures_change_what_is_seen_and_not_what_happens() -> None:
    """The same seed drives the same road, whatever the sensors do."""
    rewards = []
    for options in ({"corruption": 0.0}, {"corruption": 0.9}, {"failure": (0, "noise")}):
        env = ReliabilityDriveEnv(**options)
        env.reset(seed=5)
        rewards.append([env.step(np.array([0.2, 0.0]))[1] for _ in range(12)])
    assert rewards[0] == rewards[1] == rewards[2]


@pytest.mark.parametrize(
    "options,message",
    [
        ({"n_modalities": 1}, "n_modalities.*got 1"),
        ({"n_modalities": 7}, "n_modalities.*got 7"),
        ({"corruption": 1.5}, "corruption.*1.5"),
        ({"corruption": float("nan")}, "corruption.*nan"),
        ({"max_episode_steps": 0}, "max_episode_steps.*0"),
        ({"n_blind": -1}, "n_blind.*-1"),
        ({"n_blind": 12}, "n_blind.*12"),
        ({"failure": (3, "black")}, "modality in 0..2"),
        ({"failure": (0, "sound")}, "'black', 'frozen', 'noise'"),
        ({"failure": (0, "dark")}, "'black', 'frozen', 'noise'"),
        ({"failure": "black"}, "must be \\(modality, condition\\)"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ReliabilityDriveEnv(**options)
