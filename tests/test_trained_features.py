"""Training with the frozen encoders of a trained driver."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecTransposeImage

import sb3_have  # noqa: F401
from sb3_have.configuration import load_config
from sb3_have.train import Run, make_training_env
from sb3_have.trained import pretrained
from sb3_have.trained.features import EncodedImages, on_features, with_encoders

ENV_ID = "HighwayVision-v0"
DRIVER = pretrained("have", "cpu")


def make_env() -> gym.Env[Any, Any]:
    return gym.make(ENV_ID, weather="ClearNight", **DRIVER.env_kwargs)


def test_the_features_are_those_of_the_stacked_frames() -> None:
    env = EncodedImages(make_env())
    images: Any = VecTransposeImage(VecFrameStack(DummyVecEnv([make_env]), 3))
    images.seed(7)
    features, stacked = env.reset(seed=7)[0], images.reset()
    before = {"rgb": np.zeros(0, np.float32)}
    for step in range(6):
        assert env.observation_space.contains(features)
        assert step == 0 or not np.allclose(features["rgb"], before["rgb"], atol=1e-3), "frames change"
        with th.no_grad():
            expected = DRIVER.encoder({name: th.as_tensor(image) for name, image in stacked.items()})[0].numpy()
        for i, name in enumerate(DRIVER.encoder.modalities):
            np.testing.assert_allclose(features[name], expected[i], atol=1e-5, err_msg=f"{name}, step {step}")
        before = features
        action = np.array([0.5, 0.02 * step], np.float32)
        features, stacked = env.step(action)[0], images.step(action[None])[0]
    # The frames of the last episode are gone
    again = env.reset(seed=7)[0]
    images.seed(7)
    with th.no_grad():
        expected = DRIVER.encoder({name: th.as_tensor(image) for name, image in images.reset().items()})[0].numpy()
    np.testing.assert_allclose(list(again.values()), expected, atol=1e-5)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_model_that_learned_on_features_drives_on_images(tmp_path: Any, n_envs: int) -> None:
    config = load_config("have", ENV_ID) | {"learning_starts": 4, "batch_size": 4, "n_envs": n_envs}
    run = Run(on_features(config), ENV_ID, tmp_path, eval_freq=0, save_freq=0, device="cpu")
    learned: Any = run.train(12)
    assert not any("encoder" in name for name, _ in learned.critic.named_parameters())

    joined: Any = with_encoders(learned, config, make_training_env(ENV_ID, {**config, "n_envs": 1}))
    assert joined.num_timesteps == 12
    observation = joined.get_env().reset()
    with th.no_grad():
        encoded = DRIVER.encoder({name: th.as_tensor(image) for name, image in observation.items()})[0].numpy()
    features = dict(zip(DRIVER.encoder.modalities, encoded, strict=True))
    action, _ = learned.predict(features, deterministic=True)
    np.testing.assert_allclose(joined.predict(observation, deterministic=True)[0][0], action, atol=1e-5)
    weights = joined.policy.modality_weights(observation)
    for name, weight in learned.policy.modality_weights(features).items():
        np.testing.assert_allclose(weights[name][0], weight, atol=1e-5)
    # Encoders and networks can be trained on together
    before = joined.critic.encoder.state_dict()["encoders.0.output.0.weight"].clone()
    joined.learn(10)
    assert not th.equal(joined.critic.encoder.state_dict()["encoders.0.output.0.weight"], before)


def test_other_wrappers_stay_inside() -> None:
    given = {"env_wrapper": "gymnasium.wrappers.RecordEpisodeStatistics", "policy_kwargs": {"net_arch": [8]}}
    config = on_features(given)
    assert config["env_wrapper"] == [
        given["env_wrapper"],
        {"sb3_have.trained.features.EncodedImages": {"name": "have"}},
    ]
    assert config["policy_kwargs"]["net_arch"] == [8] and given.keys() == {"env_wrapper", "policy_kwargs"}
