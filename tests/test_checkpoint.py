"""Training that resumes from a checkpoint ends with the same bits as training that never stopped."""

import multiprocessing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs import TINY, RandomSensors, vectors_space
from gymnasium.wrappers import TransformReward
from resuming import Drifting, assert_resumes, assert_same, everything
from sb3_contrib import TQC
from stable_baselines3 import SAC, TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_have import HAVESAC, DeepMDPCallback
from sb3_have.checkpoint import (
    ResumableCheckpointCallback,
    ResumableEnv,
    checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from sb3_have.checkpoint.env_state import environments_state, restore_environments
from sb3_have.checkpoint.stopping import TrainingStopped, stop_training
from sb3_have.common.crossq import MultiInputCrossQ


def sac(env: Any, algorithm: Any = SAC, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    policy_kwargs = {"net_arch": [8], **kwargs.pop("policy_kwargs", {})}
    defaults: dict[str, Any] = {"buffer_size": 100, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    return algorithm(policy, env, policy_kwargs=policy_kwargs, **{**defaults, **kwargs})


def have(env: Any, **kwargs: Any) -> HAVESAC:
    model: HAVESAC = sac(env, HAVESAC, "MultiInputPolicy", policy_kwargs=TINY, **kwargs)
    return model


def drifting(n_envs: int = 1) -> VecEnv:
    return DummyVecEnv([lambda: Monitor(Drifting())] * n_envs)


def normalized(n_envs: int = 1) -> VecEnv:
    return VecNormalize(VecFrameStack(drifting(n_envs), 3))


def pendulum() -> gym.Env[Any, Any]:
    """An environment of Gymnasium with a lambda in a wrapper."""
    return TransformReward(gym.make("Pendulum-v1", max_episode_steps=31), lambda reward: 0.1 * float(reward))


def highway(n_envs: int = 1) -> VecEnv:
    kwargs: dict[str, Any] = {"image_size": 36, "modalities": ("rgb", "event"), "vehicles_count": 3}
    make = partial(gym.make, "HighwayVision-v0", weather="random", max_episode_steps=13, **kwargs)
    return VecFrameStack(DummyVecEnv([lambda: Monitor(make())] * n_envs), 2)


def goals() -> gym.Env[Any, Any]:
    return BitFlippingEnv(n_bits=3, continuous=True, max_steps=5)


def noise(size: int) -> OrnsteinUhlenbeckActionNoise:
    return OrnsteinUhlenbeckActionNoise(np.zeros(size), np.full(size, 0.5))


CASES: dict[str, tuple[Any, Any]] = {
    "every step": (sac, drifting),
    "within the warm-up": (partial(sac, learning_starts=30), drifting),
    "every 2nd step of 2": (partial(sac, train_freq=2, gradient_steps=2), partial(drifting, 2)),
    "every episode": (partial(sac, train_freq=(1, "episode")), pendulum),
    "normalized": (sac, normalized),
    "normalized, 2": (sac, partial(normalized, 2)),
    "gSDE": (partial(sac, use_sde=True, train_freq=2), partial(drifting, 2)),
    "gSDE, drawn more often": (partial(sac, use_sde=True, sde_sample_freq=3, train_freq=5), drifting),
    "overlapping observations": (
        partial(sac, optimize_memory_usage=True, replay_buffer_kwargs={"handle_timeout_termination": False}),
        drifting,
    ),
    "n steps": (partial(sac, n_steps=3), drifting),
    "TQC, temperature given": (partial(sac, algorithm=TQC, ent_coef=0.1), drifting),
    "TD3 with noise, 2": (lambda env: sac(env, TD3, action_noise=noise(2)), partial(drifting, 2)),
    "goals": (
        lambda env: sac(env, SAC, "MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=12),
        goals,
    ),
    "CrossQ": (
        lambda env: sac(env, MultiInputCrossQ, "MultiInputPolicy", learning_rate=lambda left: 1e-3 * left),
        lambda: RandomSensors(vectors_space()),
    ),
    "HAVE, vectors": (
        partial(have, policy_delay=2, modality_dropout=0.3),
        partial(gym.make, "ReliabilityDrive-v0"),
    ),
    "HAVE, vectors, gSDE": (partial(have, use_sde=True), lambda: RandomSensors(vectors_space())),
    "HAVE, images": (partial(have, n_steps=3, replay_buffer_kwargs={"storage": "mmap"}), highway),
    "HAVE, images, 2": (partial(have, random_shift=2), partial(highway, 2)),
}


@pytest.mark.parametrize("case", CASES)
def test_resumed_training_is_the_same(case: str, tmp_path: Path) -> None:
    make_model, make_env = CASES[case]
    assert_resumes(tmp_path, make_model, make_env, 23, 42)


def test_five_hundred_steps_later(tmp_path: Path) -> None:
    assert_resumes(tmp_path, partial(sac, train_freq=4, buffer_size=400), normalized, 100, 600)


def test_schedules_go_on(tmp_path: Path) -> None:
    def deep_mdp() -> list[BaseCallback]:
        return [DeepMDPCallback(transition_coef=0.5, schedule=lambda left: left**2)]

    make_env = partial(RandomSensors, vectors_space())
    model = assert_resumes(tmp_path, partial(have, learning_rate=lambda left: 1e-3 * left), make_env, 23, 40, deep_mdp)
    assert isinstance(model, HAVESAC) and model.auxiliary_coefs["transition"] < 0.01


@pytest.fixture
def warm_workers() -> None:
    """Import once what all worker processes need."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(["resuming", "sb3_have.checkpoint.env_state"])


@pytest.mark.usefixtures("warm_workers")
def test_worker_processes(tmp_path: Path) -> None:
    def make_env() -> VecEnv:
        return VecNormalize(SubprocVecEnv([lambda: ResumableEnv(Monitor(Drifting()))] * 2))

    assert_resumes(tmp_path, sac, make_env, 23, 40)


@pytest.mark.usefixtures("warm_workers")
def test_worker_processes_of_other_environments(tmp_path: Path) -> None:
    """They are refused without ending the workers."""

    def workers(*wrappers: Any) -> SubprocVecEnv:
        def make() -> gym.Env[Any, Any]:
            env: gym.Env[Any, Any] = Drifting()
            for wrapper in wrappers:
                env = wrapper(env)
            return env

        return SubprocVecEnv([make])

    inner, whole, bare = workers(ResumableEnv, Monitor), workers(Monitor, ResumableEnv), workers(ResumableEnv)
    state = environments_state(whole)
    assert state.lost == []
    with pytest.raises(ValueError, match="has to be the outermost wrapper"):
        restore_environments(inner, state)
    with pytest.raises(
        ValueError, match="ResumableEnv > Monitor > Drifting, but the environment has ResumableEnv > Drifting"
    ):
        restore_environments(bare, state)
    bare.reset()

    # Without access to the workers new episodes begin
    model = sac(inner).learn(12)
    with pytest.warns(UserWarning, match=r"SubprocVecEnv, which need ResumableEnv as the outermost .*new episodes"):
        save_checkpoint(model, tmp_path / "mine")
    resumed = load_checkpoint(tmp_path / "mine", inner, device="cpu")
    assert resumed._last_obs is None
    assert resumed.learn(1, reset_num_timesteps=False).num_timesteps == 13
    for env in (inner, whole, bare):
        env.close()


def test_training_that_a_callback_ends(tmp_path: Path) -> None:
    """Its last transition is not stored, so there is no checkpoint of that step."""

    class Ends(BaseCallback):
        def _on_step(self) -> bool:
            return self.num_timesteps < 25

    with pytest.warns(UserWarning, match=r"A callback ended the training at step 25 .*no checkpoint was saved"):
        sac(drifting()).learn(40, [ResumableCheckpointCallback(tmp_path, 10), Ends()])
    assert [path.name for path in checkpoints(tmp_path)] == ["checkpoint-10", "checkpoint-20"]


def test_saving_does_not_disturb(tmp_path: Path) -> None:
    without = everything(sac(drifting(), use_sde=True).learn(40))
    saving = sac(drifting(), use_sde=True).learn(40, ResumableCheckpointCallback(tmp_path, 5))
    assert len(checkpoints(tmp_path)) == 2
    assert_same(everything(saving), without)


@pytest.mark.parametrize("freq", [10, 100], ids=["where one is due", "where none is due"])
def test_training_stopped_between_rollouts(tmp_path: Path, freq: int) -> None:
    """As by StopTrainingOnSignal; gSDE's noise of the next rollout has been drawn by then."""

    class Stops(BaseCallback):
        def _on_rollout_start(self) -> None:
            if self.model.num_timesteps == 30:
                stop_training(self)

        def _on_step(self) -> bool:
            return True

    expected = everything(sac(drifting(), use_sde=True, action_noise=noise(2)).learn(45))
    callback = ResumableCheckpointCallback(tmp_path, freq)
    with pytest.raises(TrainingStopped):
        sac(drifting(), use_sde=True, action_noise=noise(2)).learn(45, [callback, Stops()])
    assert checkpoints(tmp_path)[-1].name == "checkpoint-30"
    resumed = load_checkpoint(tmp_path, drifting(), callback, device="cpu")
    assert_same(everything(resumed.learn(15, callback, reset_num_timesteps=False)), expected)


@pytest.mark.parametrize(
    ("kwargs", "n_envs"), [({"algorithm": TD3}, 1), ({"algorithm": TD3}, 2), ({"use_sde": True}, 1)]
)
def test_noise_after_the_end_of_training(tmp_path: Path, kwargs: dict[str, Any], n_envs: int) -> None:
    """The checkpoint at the end continues the action noise, which `learn` would reset, but not gSDE's."""

    def make_model() -> Any:
        model = sac(drifting(n_envs), action_noise=noise(2), **kwargs)
        for env in model.get_env().unwrapped.envs:
            env.action_space.seed(1)
        return model

    expected = everything(make_model().learn(40))
    callback = ResumableCheckpointCallback(tmp_path, 0)
    make_model().learn(20, callback)
    resumed = load_checkpoint(tmp_path, drifting(n_envs), callback, device="cpu")
    assert_same(everything(resumed.learn(20, callback, reset_num_timesteps=False)), expected)


def test_between_two_calls_of_learn(tmp_path: Path) -> None:
    model = sac(normalized(), use_sde=True)
    model.learn(20)
    save_checkpoint(model, tmp_path / "mine")
    model.learn(20, reset_num_timesteps=False)
    other = load_checkpoint(tmp_path / "mine", normalized(), device="cpu")
    other.learn(20, reset_num_timesteps=False)
    assert_same(everything(other), everything(model))


def test_loaded_model_can_be_saved_at_once(tmp_path: Path) -> None:
    first, callback = sac(drifting(), use_sde=True, action_noise=noise(2)), ResumableCheckpointCallback(tmp_path, 23)
    first.learn(40, callback)
    again = load_checkpoint(tmp_path / "checkpoint-23", drifting(), callback, device="cpu")
    save_checkpoint(again, tmp_path / "new" / "folder" / "copy", callback)
    callback = ResumableCheckpointCallback(tmp_path / "new", 23)
    second = load_checkpoint(tmp_path / "new" / "folder" / "copy", drifting(), callback, device="cpu")
    second.learn(17, callback, reset_num_timesteps=False)
    assert_same(everything(second), everything(first))


def test_monitor_continues_its_file(tmp_path: Path) -> None:
    def make_env(override: bool) -> VecEnv:
        return DummyVecEnv([lambda: Monitor(Drifting(), str(tmp_path / "monitor.csv"), override_existing=override)])

    env = make_env(True)
    sac(env).learn(23, ResumableCheckpointCallback(tmp_path, 23))
    env.close()
    env = make_env(False)
    load_checkpoint(tmp_path, env, device="cpu").learn(20, reset_num_timesteps=False)
    env.close()
    _, head, *rows = (tmp_path / "monitor.csv").read_text().splitlines()
    assert head.startswith("r,l,t") and [row.split(",")[1] for row in rows] == ["9"] * 4
    times = [float(row.split(",")[2]) for row in rows]
    assert times == sorted(times)
