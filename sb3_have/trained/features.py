"""Training with the frozen encoders of a trained driver: on their features instead of images, which is fast."""

from __future__ import annotations

import multiprocessing
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_have.configuration import model_kwargs
from sb3_have.have.have import HAVESAC
from sb3_have.trained import pretrained


class EncodedImages(gym.ObservationWrapper[Any, Any, Any]):
    """
    Replace the images of ``HighwayVision-v0`` with the features that a trained driver's encoders compute from them.

    The wrapper stacks the frames itself, as ``VecFrameStack`` does: frames before the first one are 0.

    :param env: Environment whose images, uint8 (height, width, channels), the driver was trained on
    :param name: Name of the driver
    """

    def __init__(self, env: gym.Env[Any, Any], name: str = "have") -> None:
        super().__init__(env)
        if multiprocessing.parent_process() is not None:
            # Environments in processes of their own would compete for the cores
            th.set_num_threads(1)
        self.encoder = pretrained(name, "cpu").encoder
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


def on_features(config: Mapping[str, Any], name: str = "have") -> dict[str, Any]:
    """
    Return a configuration that trains on the features of a driver's encoders.

    :param config: Configuration that trains on the images that the driver was trained on
    :param name: Name of the driver
    """
    wrappers = config.get("env_wrapper") or []
    wrappers = wrappers if isinstance(wrappers, list) else [wrappers]
    encoder = pretrained(name, "cpu").encoder
    policy_kwargs = {
        **config.get("policy_kwargs", {}),
        "features_dim": encoder.features_dim,
        "encoder_classes": dict.fromkeys(encoder.modalities, "torch.nn.Identity"),
    }
    return {
        **config,
        "frame_stack": 1,
        "env_wrapper": [*wrappers, {f"{__name__}.EncodedImages": {"name": name}}],
        "policy_kwargs": policy_kwargs,
    }


def with_encoders(model: HAVESAC, config: Mapping[str, Any], env: VecEnv, name: str = "have") -> HAVESAC:
    """
    Return a model that reads images: a driver's encoders, and behind them the networks that learned on their features.

    Its optimizers and entropy coefficient are reset, and its replay buffer is empty. In the training, the
    features are computed on the CPU. On a GPU, whose encoders may compute in bfloat16, they differ a little.

    :param model: Model that was trained with the configuration from :func:`on_features`
    :param config: The configuration that was given to :func:`on_features`
    :param env: Environment with images
    :param name: Name of the driver
    """
    joined = HAVESAC(env=env, seed=model.seed, device=model.device, **model_kwargs(config, env))
    state = model.policy.state_dict()
    for key, tensor in pretrained(name, "cpu").encoder.state_dict().items():
        state |= {f"{critic}.encoder.{key}": tensor for critic in ("critic", "critic_target")}
    joined.policy.load_state_dict(state)
    joined.num_timesteps = model.num_timesteps
    return joined
