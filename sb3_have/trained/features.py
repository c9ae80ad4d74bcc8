"""Train with the frozen encoders of a trained driver: on their features instead of images, which is fast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.configuration import model_kwargs
from sb3_have.have.have import HAVESAC
from sb3_have.trained import pretrained


class EncodedImages(gym.ObservationWrapper[Any, Any, Any]):
    """
    Replace the images of ``HighwayVision-v0`` by the features that a trained driver's encoders compute from them.

    The wrapper stacks the frames itself, as ``VecFrameStack`` does: frames before the first one are 0.

    :param env: Environment whose images, uint8 (height, width, channels), the driver was trained on
    :param name: Name of the driver
    """

    def __init__(self, env: gym.Env[Any, Any], name: str = "have") -> None:
        super().__init__(env)
        self.encoder = pretrained(name, "cpu").encoder
        # Every environment has a core
        th.set_num_threads(1)
        features = spaces.Box(-np.inf, np.inf, (self.encoder.features_dim,), np.float32)
        self.observation_space = spaces.Dict(dict.fromkeys(self.encoder.modalities, features))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.stacks = {
            name: np.zeros(modality.space.shape, np.uint8) for name, modality in self.encoder.modalities.items()
        }
        return super().reset(**kwargs)

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        for name, image in observation.items():
            frame, stack = np.moveaxis(image, -1, 0), self.stacks[name]
            self.stacks[name] = np.concatenate([stack[len(frame) :], frame])
        with th.no_grad():
            features = self.encoder({name: th.as_tensor(stack[None]) for name, stack in self.stacks.items()})[0]
        return dict(zip(self.encoder.modalities, features.numpy(), strict=True))


class NoEncoder(nn.Module):
    """
    Stands for an encoder where the observations are features already.

    :param observation_space: Box of shape (features_dim,)
    :param features_dim: Number of features
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int) -> None:
        super().__init__()

    def forward(self, features: th.Tensor) -> th.Tensor:
        return features


def on_features(config: Mapping[str, Any], encoder: MultiModalEncoder) -> dict[str, Any]:
    """
    Return a configuration that trains on the features of frozen encoders.

    :param config: Configuration that trains on images
    :param encoder: Encoders of the driver "have"
    """
    policy_kwargs = {**config.get("policy_kwargs", {}), "encoder_classes": dict.fromkeys(encoder.modalities, NoEncoder)}
    wrapper = f"{EncodedImages.__module__}.{EncodedImages.__name__}"
    return {**config, "frame_stack": None, "env_wrapper": wrapper, "policy_kwargs": policy_kwargs}


def with_encoders(model: HAVESAC, encoder: MultiModalEncoder, config: Mapping[str, Any], env: VecEnv) -> HAVESAC:
    """
    Return a model that reads images: the encoders, and behind them the networks that learned on their features.

    :param model: A model trained as :func:`on_features` says
    :param encoder: Encoders of the driver "have"
    :param config: Configuration that trains on images
    :param env: Environment with images
    """
    joined = HAVESAC(env=env, seed=model.seed, device=model.device, **model_kwargs(config, env))
    state = model.policy.state_dict()
    for critic in ("critic", "critic_target"):
        state |= {f"{critic}.encoder.{name}": tensor for name, tensor in encoder.state_dict().items()}
    joined.policy.load_state_dict(state)
    joined.num_timesteps = model.num_timesteps
    return joined
