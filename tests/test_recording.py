"""Recordings: observations, actions, rewards and values of a step belong together, in any environment."""

import pickle
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs import RandomSensors, sensors_space, tiny_model, vector, vectors_space
from fake_drive import ENV_ID, FakeDrive
from gymnasium import spaces
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_have import HAVESAC
from sb3_have.checkpoint import save_checkpoint
from sb3_have.envs.drivers import RandomDriver
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.evaluation.wrapping import saved_normalizer


def test_a_policy_is_recorded_as_its_model_is() -> None:
    model = tiny_model(vectors_space())
    recordings = [record_episode(driver, RandomSensors(vectors_space(), length=3)) for driver in (model, model.policy)]
    for name, values in recordings[0].values.items():
        np.testing.assert_array_equal(recordings[1].values[name], values)
    assert recordings[0].values and recordings[1].weights.keys() == recordings[0].weights.keys()


def of_step(recording: Recording, step: int) -> dict[str, np.ndarray]:
    return {key: value[None] for key, value in recording.observations[step].items()}


def test_values_weights_actions_and_rewards_of_a_step_belong_together() -> None:
    env = RandomSensors(vectors_space(3), length=6)
    model = tiny_model(vectors_space(3))
    recording = record_episode(model, env, seed=5)
    assert recording.actions.shape == (6, 2) and recording.rewards.shape == (6,)
    assert {key: value.shape for key, value in recording.values.items()} == {
        "q": (2, 6),
        "q_global": (2, 6),
        "q_lve": (2, 6),
        "q_local": (2, 3, 6),
    }
    for step in (0, 4):
        seen = of_step(recording, step)
        action, _ = model.predict(seen, deterministic=True)
        np.testing.assert_allclose(recording.actions[step], action[0], rtol=1e-5)
        assert recording.rewards[step] == pytest.approx(-float(np.square(action).sum()), rel=1e-5)
        for name, weight in model.modality_weights(seen).items():
            assert recording.weights[name][step] == pytest.approx(weight[0], rel=1e-5)
        tensors, _ = model.policy.obs_to_tensor(seen)
        with th.no_grad():
            q = model.critic(tensors, th.as_tensor(model.policy.scale_action(action)))
        np.testing.assert_allclose(recording.values["q"][:, step], [float(part) for part in q], rtol=1e-4)
    weighted = sum(recording.weights[name] * recording.values["q_local"][:, i] for i, name in enumerate("abc"))
    np.testing.assert_allclose(recording.values["q_lve"], weighted, rtol=1e-4, atol=1e-5)


def test_an_environment_that_was_made_is_left_at_the_end_of_its_episode() -> None:
    class Counts(RandomSensors):
        resets = closed = 0

        def reset(self, **kwargs: Any) -> Any:
            self.resets += 1
            return super().reset(**kwargs)

        def close(self) -> None:
            self.closed += 1

    env = Counts(vectors_space(), length=4)
    recording = record_episode(tiny_model(vectors_space()), env)
    assert (env.resets, env.steps, env.closed) == (1, 4, 0)
    assert not recording.pictures and recording.seconds is None and recording.weather == ""
    np.testing.assert_array_equal(recording.times, np.arange(4))
    again = record_episode(tiny_model(vectors_space()), env)
    np.testing.assert_array_equal(again.observations[2]["a"], recording.observations[2]["a"])


def test_an_id_without_weather_is_rendered_where_it_can_be() -> None:
    recording = record_episode(RandomDriver(), ENV_ID, env_kwargs={"image_size": 40}, seed=1, render=True)
    assert len(recording.rewards) == len(recording.pictures) == 5
    assert recording.pictures[0].shape == (40, 80, 3) and recording.seconds == 0.2
    assert recording.rewards == pytest.approx(1 + recording.actions[:, 0])  # slow: 1 m and the throttle
    # Each info is from before the action
    assert [info["distance"] for info in recording.infos] == [0, 1, 2, 3, 4] and recording.end["distance"] == 5
    assert not recording.values and not recording.weights
    assert not record_episode(RandomDriver(), ENV_ID).pictures
    assert len(record_episode(RandomDriver(), ENV_ID, "fast", max_steps=2).rewards) == 2


def test_an_environment_is_closed_whatever_its_wrapper_does(monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[str] = []
    monkeypatch.setattr(FakeDrive, "close", lambda self: closed.append("environment"))

    class Wrapper(gym.Wrapper[Any, Any, Any, Any]):
        def close(self) -> None:
            closed.append("wrapper")
            super().close()

    def broken(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
        raise RuntimeError("no such sensor")

    with pytest.raises(RuntimeError, match="no such sensor"):
        record_episode(RandomDriver(), ENV_ID, env_wrapper=broken)
    assert closed == ["environment"]
    record_episode(RandomDriver(), ENV_ID, env_wrapper=Wrapper, max_steps=1)
    assert closed == ["environment", "wrapper", "environment"]


def test_statistics_for_a_model_without_its_environment(tmp_path: Path) -> None:
    env = VecNormalize(VecFrameStack(DummyVecEnv([lambda: RandomSensors(vectors_space())]), 2), norm_obs_keys=["a"])
    model = tiny_model(vectors_space(), env=env)
    model.learn(30)
    with_env = record_episode(model, RandomSensors(vectors_space()), seed=1)
    env.save(str(tmp_path / "vecnormalize.pkl"))
    save_checkpoint(model, tmp_path / "checkpoint-30")
    model.env = model._vec_normalize_env = None
    for name in ("vecnormalize.pkl", "checkpoint-30"):
        normalizer = saved_normalizer(tmp_path / name)
        again = record_episode(model, RandomSensors(vectors_space()), seed=1, normalizer=normalizer)
        np.testing.assert_array_equal(again.actions, with_env.actions)
    without = record_episode(model, RandomSensors(vectors_space()), seed=1)
    assert np.abs(without.actions - with_env.actions).max() > 1e-3
    (tmp_path / "other.pkl").write_bytes(pickle.dumps([1]))
    with pytest.raises(ValueError, match=r"other\.pkl holds a list, not a VecNormalize"):
        saved_normalizer(tmp_path / "other.pkl")
    plain = tiny_model(vectors_space())
    save_checkpoint(plain, tmp_path / "checkpoint-0")
    assert saved_normalizer(tmp_path / "checkpoint-0") is None


def test_a_box_observation_has_values_too() -> None:
    env = RandomSensors(vector(3), length=5)
    recording = record_episode(HAVESAC("MlpPolicy", env, buffer_size=10, device="cpu"), env)
    assert recording.observations[0].shape == (3,) and list(recording.weights) == ["observation"]
    np.testing.assert_allclose(recording.weights["observation"], 1)
    assert recording.values["q_local"].shape == (2, 1, 5)


def test_the_global_critic_alone_has_a_value_and_no_weights() -> None:
    recording = record_episode(tiny_model(vectors_space(), value_estimation="gve"), RandomSensors(vectors_space()))
    assert recording.weights == {} and set(recording.values) == {"q", "q_global"}


@pytest.mark.parametrize("normalize_first", [True, False])
def test_the_wrappers_of_the_training_are_put_on_in_their_order(normalize_first: bool) -> None:
    env = DummyVecEnv([lambda: RandomSensors(vectors_space())])
    model: PPO | SAC
    if normalize_first:  # off-policy algorithms refuse this order, because they store unnormalised observations
        stacked = VecFrameStack(VecNormalize(env), 3, {"a": "first", "b": "last"})
        model = PPO("MultiInputPolicy", stacked, n_steps=10, batch_size=10, n_epochs=1, seed=0, device="cpu")
    else:
        model = tiny_model(vectors_space(), env=VecNormalize(VecFrameStack(env, 3)))
    model.learn(20)
    own = RandomSensors(vectors_space(), length=8)
    recording = record_episode(model, own, seed=2)
    frozen = model.get_vec_normalize_env()
    assert frozen is not None
    frames: Any = [{key: value[None] for key, value in recording.observations[step].items()} for step in (3, 4, 5)]
    if normalize_first:
        frames = [frozen.normalize_obs(frame) for frame in frames]
    seen: Any = {key: np.concatenate([frame[key] for frame in frames], axis=-1) for key in "ab"}
    seen = seen if normalize_first else frozen.normalize_obs(seen)
    action, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(recording.actions[5], action[0], rtol=1e-4, atol=1e-5)


def test_normalised_images_do_not_change_the_space_of_the_environment() -> None:
    """VecNormalize writes into the space that it is given."""
    space = spaces.Dict({"camera": spaces.Box(0, 255, (3, 36, 36), np.uint8), "state": vector(2)})
    env = VecNormalize(DummyVecEnv([lambda: RandomSensors(deepcopy(space))]), norm_obs_keys=["camera", "state"])
    keywords: dict[str, Any] = {"net_arch": [8], "normalize_images": False}
    model = SAC("MultiInputPolicy", env, policy_kwargs=keywords, buffer_size=50, device="cpu")
    own = RandomSensors(deepcopy(space), length=3)
    record_episode(model, own)
    assert own.observation_space == space


def test_images_are_stacked_and_transposed_for_a_model_without_its_environment() -> None:
    env = VecFrameStack(DummyVecEnv([lambda: RandomSensors(sensors_space())]), 2)
    model = tiny_model(sensors_space(), env=env)
    with_env = record_episode(model, RandomSensors(sensors_space()), seed=1)
    model.env = None
    without = record_episode(model, RandomSensors(sensors_space()), seed=1)
    np.testing.assert_array_equal(with_env.weights["rgb"], without.weights["rgb"])
    assert with_env.observations[0]["rgb"].shape == (36, 36, 3)


def test_what_does_not_fit() -> None:
    model = tiny_model(vectors_space())
    with pytest.raises(ValueError, match="do not fit"):
        record_episode(model, RandomSensors(vectors_space(3)))
    with pytest.raises(TypeError, match="vectorized"):
        record_episode(model, DummyVecEnv([lambda: RandomSensors(vectors_space())]))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="weather"):
        record_episode(model, RandomSensors(vectors_space()), "ClearNoon")
    with pytest.raises(gym.error.Error):
        record_episode(model, "NoSuchEnv-v0")
