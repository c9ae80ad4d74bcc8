"""Replay buffers in checkpoints, cut where new episodes begin."""

import threading
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from resuming import Drifting
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv

from sb3_have import ModalityReplayBuffer
from sb3_have.checkpoint import load_checkpoint, save_checkpoint
from sb3_have.checkpoint.checkpoint import end_last_episode

KINDS: dict[str, tuple[type[ReplayBuffer], dict[str, Any]]] = {
    "n steps": (NStepReplayBuffer, {"n_steps": 3, "gamma": 1.0}),
    "n steps, timeouts as terminations": (
        NStepReplayBuffer,
        {"n_steps": 3, "gamma": 1.0, "handle_timeout_termination": False},
    ),
    "overlapping observations": (ReplayBuffer, {"optimize_memory_usage": True, "handle_timeout_termination": False}),
    "stock": (ReplayBuffer, {}),
    "frames once": (ModalityReplayBuffer, {"n_steps": 3, "gamma": 1.0}),
}
SIZE, N_ENVS = 7, 2


def make_buffer(kind: str) -> Any:
    cls, kwargs = KINDS[kind]
    env = Drifting()
    return cls(SIZE * N_ENVS, env.observation_space, env.action_space, "cpu", n_envs=N_ENVS, **kwargs)


def add(buffer: Any, obs: int, reward: float = 1.0, done: Any = (0, 0)) -> None:
    """A transition of every environment from ``obs`` to the next number."""
    stacks = [np.full((N_ENVS, 2), number, np.float32) for number in (obs, obs + 1)]
    buffer.add(*stacks, np.zeros((N_ENVS, 2)), np.full(N_ENVS, reward), np.array(done), [{}] * N_ENVS)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n_before", [1, 4, SIZE, SIZE + 3])
def test_nothing_runs_across_the_cut(kind: str, n_before: int) -> None:
    """The second environment has just ended its episode, which stays a termination."""
    buffer = make_buffer(kind)
    for step in range(n_before):
        add(buffer, step, done=(0, step == n_before - 1))
    end_last_episode(buffer)
    for step in range(3):
        add(buffer, 1000 + step, reward=1000.0)
    np.random.seed(0)
    samples = buffer.sample(500)
    before, goes_on = samples.observations[:, 0] < 1000, samples.dones[:, 0] == 0
    assert before.any() and goes_on.any()
    assert not (before & goes_on & (samples.next_observations[:, 0] >= 1000)).any(), "another episode's observation"
    assert (samples.rewards[before, 0] < 1000).all()
    if buffer.handle_timeout_termination:
        last = before & (samples.next_observations[:, 0] == n_before)
        assert 0.3 < samples.dones[last].mean() < 0.7, "only of the episode that has ended"
    cut = (n_before - 1) % SIZE
    for row in range(SIZE):
        if row != cut:
            assert not buffer.dones[row].any() and not buffer.timeouts[row].any()


@pytest.mark.parametrize("kind", KINDS)
def test_empty_buffer_is_not_cut(kind: str) -> None:
    buffer = make_buffer(kind)
    end_last_episode(buffer)
    assert not buffer.dones.any() and not buffer.timeouts.any()


def sac(env: Any, policy: str = "MultiInputPolicy", **kwargs: Any) -> SAC:
    policy_kwargs = {"net_arch": [4]}
    return SAC(policy, env, policy_kwargs=policy_kwargs, learning_starts=99, seed=0, device="cpu", **kwargs)


def test_no_second_buffer_is_created(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SB3 would create one, and warn where there is no memory for both."""
    save_checkpoint(sac(Drifting(), "MlpPolicy", buffer_size=50).learn(9), tmp_path / "mine")

    def make(*args: Any, **kwargs: Any) -> None:
        raise AssertionError

    monkeypatch.setattr(ReplayBuffer, "__init__", make)
    assert load_checkpoint(tmp_path / "mine", Drifting(), device="cpu").replay_buffer.pos == 9


class Connected(Drifting):
    """Holds what cannot be pickled."""

    def __init__(self) -> None:
        super().__init__()
        self.connection = threading.Lock()


def test_cut_where_new_episodes_begin(tmp_path: Path) -> None:
    model = sac(Connected(), "MlpPolicy", buffer_size=50, n_steps=3).learn(5)
    with pytest.warns(UserWarning, match=r"Connected\.connection"):
        save_checkpoint(model, tmp_path / "mine")
    resumed = load_checkpoint(tmp_path / "mine", Connected(), device="cpu").learn(2, reset_num_timesteps=False)
    assert resumed.replay_buffer.timeouts[:7, 0].tolist() == [0, 0, 0, 0, 1, 0, 0]


def test_goals_are_cut_without_warning() -> None:
    """SB3 warns and advises not to cut."""
    env = BitFlippingEnv(n_bits=3, continuous=True, max_steps=5)
    model = sac(env, buffer_size=50, replay_buffer_class=HerReplayBuffer).learn(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        end_last_episode(model.replay_buffer)  # type: ignore[arg-type]
    assert model.replay_buffer.dones[2] and model.replay_buffer.timeouts[2]  # type: ignore[union-attr]


def test_rows_without_a_transition_are_not_saved(tmp_path: Path) -> None:
    """SB3's buffers reserve all of `buffer_size`."""
    model = sac(Drifting(), "MlpPolicy", buffer_size=200_000).learn(9)
    save_checkpoint(model, tmp_path / "mine")
    buffer: Any = model.replay_buffer
    observations = buffer.observations.nbytes
    assert observations > 1e6 and (tmp_path / "mine").stat().st_size < 200_000 * 16 + 3e6
    loaded = load_checkpoint(tmp_path / "mine", Drifting())
    buffers = [model.replay_buffer, loaded.replay_buffer]
    for name in ("observations", "next_observations"):
        ours, theirs = (getattr(buffer, name) for buffer in buffers)
        np.testing.assert_array_equal(ours, theirs)
    loaded.learn(20, reset_num_timesteps=False)
