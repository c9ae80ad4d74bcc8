"""The state of environments, complete or with a warning, and that of callbacks."""

import random
import threading
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils import EzPickle
from gymnasium.wrappers import TimeLimit, TransformReward
from resuming import Drifting, assert_same, everything, leaves
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_have.checkpoint import ResumableEnv, load_checkpoint, save_checkpoint
from sb3_have.checkpoint.env_state import environments_state, restore_environments


class Connected(Drifting):
    """Holds what cannot be pickled."""

    def __init__(self) -> None:
        super().__init__()
        self.connection = threading.Lock()
        self.road = {"signal": threading.Lock()}


class Named(Drifting, EzPickle):
    """Pickles as the call that makes a new one."""

    def __init__(self, length: int = 9):
        Drifting.__init__(self, length)
        EzPickle.__init__(self, length)


def make_vec_env(env: type[Drifting] = Drifting, n_envs: int = 1) -> VecEnv:
    return VecNormalize(DummyVecEnv([lambda: Monitor(TimeLimit(env(), 7))] * n_envs))


def rolled(env: VecEnv, steps: int = 5) -> dict[str, np.ndarray]:
    """What happens next; the environments draw from the global generators too."""
    random.seed(3)
    np.random.seed(3)
    actions = np.random.default_rng(1).uniform(-1, 1, (steps, env.num_envs, 2)).astype(np.float32)
    return leaves([env.step(action)[:3] for action in actions])


@pytest.mark.parametrize("inner", [Drifting, Named])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_environments_go_on(inner: type[Drifting], n_envs: int) -> None:
    first, second = make_vec_env(inner, n_envs), make_vec_env(inner, n_envs)
    for env in (first, second):
        env.seed(0)
        env.reset()
    rolled(first, 11)
    state = environments_state(first, shared=first.action_space)
    assert state.lost == []
    shared = restore_environments(second, state)
    assert shared is second.unwrapped.envs[0].unwrapped.action_space  # type: ignore[attr-defined]
    assert_same(rolled(second), rolled(first))
    assert second.env_method("get_total_steps") == [16] * n_envs


def test_simulator_goes_on() -> None:
    pytest.importorskip("mujoco")
    first, second = (DummyVecEnv([lambda: gym.make("InvertedPendulum-v5")]) for _ in range(2))
    first.seed(0)
    first.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (9, 1, 1)).astype(np.float32)
    for action in actions[:4]:
        first.step(action)
    state = environments_state(first)
    assert state.lost == []
    restore_environments(second, state)
    for action in actions[4:]:
        assert_same(leaves(second.step(action)[:3]), leaves(first.step(action)[:3]))


def test_parts_that_are_shared_stay_shared() -> None:
    class Watching(gym.Wrapper[Any, Any, Any, Any]):
        def __init__(self, env: gym.Env[Any, Any]):
            super().__init__(env)
            self.below, self.rng = env.unwrapped, np.random.default_rng(1)
            env.unwrapped.rng = self.rng  # type: ignore[attr-defined]
            self.watched = deque([self.rng])

    envs = [DummyVecEnv([lambda: Watching(Drifting())]) for _ in range(2)]
    envs[0].reset()
    envs[0].envs[0].rng.random(5)  # type: ignore[attr-defined]
    restore_environments(envs[1], environments_state(envs[0]))
    restored: Any = envs[1].envs[0]
    assert restored.below is restored.env and restored.rng is restored.env.rng is restored.watched[0]
    assert restored.rng.random() == envs[0].envs[0].rng.random()  # type: ignore[attr-defined]


def test_functions_and_drawing() -> None:
    def make() -> gym.Env[Any, Any]:
        return TransformReward(gym.make("Pendulum-v1", render_mode="rgb_array"), lambda reward: 2 * float(reward))

    first, second = DummyVecEnv([make]), DummyVecEnv([make])
    first.seed(0)
    first.reset()
    first.render()
    state = environments_state(first)
    assert state.lost == []
    second.reset()
    restore_environments(second, state)
    action = np.zeros((1, 1), np.float32)
    assert_same(leaves(second.step(action)[:3]), leaves(first.step(action)[:3]))
    assert np.array_equal(second.render(), first.render())  # type: ignore[arg-type]


def test_attribute_with_the_name_of_one_of_subproc_vec_env() -> None:
    """It belongs to the state of an environment."""
    first, second = DummyVecEnv([Drifting]), DummyVecEnv([Drifting])
    first.envs[0].processes = ["milling"]  # type: ignore[attr-defined]
    restore_environments(second, environments_state(first))
    assert second.envs[0].processes == ["milling"]  # type: ignore[attr-defined]


def test_attributes_computed_from_the_old_state_are_forgotten() -> None:
    first, second = make_vec_env(), make_vec_env()
    second.reset()
    second.unwrapped.envs[0].unwrapped.cached = "of another episode"  # type: ignore[attr-defined]
    first.reset()
    restore_environments(second, environments_state(first))
    assert not hasattr(second.unwrapped.envs[0].unwrapped, "cached")  # type: ignore[attr-defined]


def test_settings_of_an_environment_that_cannot_be_pickled() -> None:
    """They stay as they are: a simulator may have another port now."""
    first, second = (DummyVecEnv([partial(TimeLimit, Connected(), steps)]) for steps in (5, 7))
    first.reset()
    state = environments_state(first)
    assert len(state.lost) == 2
    restore_environments(second, state)
    assert second.get_attr("_max_episode_steps") == [7]


def test_other_environments_are_refused(tmp_path: Path) -> None:
    state = environments_state(make_vec_env())
    with pytest.raises(
        ValueError,
        match=r"VecNormalize > DummyVecEnv > Monitor > TimeLimit > Drifting, but the environment has.*> Named",
    ):
        restore_environments(make_vec_env(Named), state)
    with pytest.raises(ValueError, match="saved with the wrappers"):
        restore_environments(make_vec_env(n_envs=2), state)
    bare = environments_state(DummyVecEnv([Drifting]))
    with pytest.raises(ValueError, match="saved with the wrappers"):
        restore_environments(DummyVecEnv([lambda: ResumableEnv(Drifting())]), bare)


def sac(env: VecEnv) -> SAC:
    kwargs: dict[str, Any] = {"buffer_size": 60, "learning_starts": 8, "batch_size": 8, "seed": 0, "device": "cpu"}
    return SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, **kwargs)


def test_environment_that_cannot_be_pickled(tmp_path: Path) -> None:
    """A warning names class and attribute; everything but the episode is restored."""
    model = sac(make_vec_env(Connected)).learn(20)
    warning = r"Connected\.connection \(TypeError: .*\); Connected\.road \(TypeError: .*\)\..* begins new episodes"
    with pytest.warns(UserWarning, match=warning):
        save_checkpoint(model, tmp_path / "mine")
    resumed = load_checkpoint(tmp_path / "mine", make_vec_env(Connected), device="cpu")
    states = [everything(one) for one in (model, resumed)]
    kept = [name for name in states[0] if not name.startswith(("/last_obs", "/running"))]
    assert_same(*({name: state[name] for name in kept} for state in states))

    resumed.learn(1, reset_num_timesteps=False)
    assert resumed.num_timesteps == 21
    model.env.reset()  # type: ignore[union-attr]
    first = model._vec_normalize_env.get_original_obs()  # type: ignore[union-attr]
    assert_same(leaves(resumed.replay_buffer.observations[20]), leaves(first))


class Own(BaseCallback):
    """Chooses its state itself."""

    def __init__(self) -> None:
        super().__init__()
        self.open = threading.Lock()
        self.count = 0

    def _on_step(self) -> bool:
        self.count += 1
        return True

    def get_state(self) -> int:
        return self.count

    def set_state(self, state: int) -> None:
        self.count = state


class Stateless(BaseCallback):
    """Has a method that is not the one meant."""

    seen = 0

    def _on_step(self) -> bool:
        self.seen += 1
        return True

    def get_state(self, name: str) -> str:
        return name


def test_state_of_callbacks(tmp_path: Path) -> None:
    def callbacks() -> list[BaseCallback]:
        stop = StopTrainingOnNoModelImprovement(100)
        evaluation = EvalCallback(make_vec_env(), callback_after_eval=stop, eval_freq=4, n_eval_episodes=1, verbose=0)
        return [Own(), evaluation, EveryNTimesteps(3, Own()), StopTrainingOnMaxEpisodes(99), Stateless()]

    first, later = callbacks(), callbacks()
    save_checkpoint(sac(make_vec_env()).learn(10, first), tmp_path / "mine", CallbackList(first))
    # Another order, and one that was not there
    load_checkpoint(tmp_path / "mine", make_vec_env(), [CallbackList(later[::-1]), StopTrainingOnMaxEpisodes(9)], "cpu")
    own, evaluation, every, stop, stateless = later
    assert isinstance(every, EveryNTimesteps) and every.last_time_trigger == 9
    # They are matched in the order of their class
    assert isinstance(own, Own) and isinstance(every.callback, Own)
    assert (every.callback.count, own.count) == (10, 3) and every.callback.parent is every
    assert isinstance(evaluation, EvalCallback) and isinstance(first[1], EvalCallback)
    assert evaluation.n_calls == 10 and evaluation.best_mean_reward == first[1].best_mean_reward > -np.inf
    assert isinstance(evaluation.callback, StopTrainingOnNoModelImprovement)
    assert evaluation.callback.n_calls == 2 and evaluation.callback.last_best_mean_reward > -np.inf
    assert isinstance(stop, StopTrainingOnMaxEpisodes) and stop.n_episodes == 1
    assert isinstance(stateless, Stateless) and stateless.n_calls == 10 and stateless.seen == 0
