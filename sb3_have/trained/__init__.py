"""
Trained drivers that come with the package.

Each has two files in this folder: ``<name>.safetensors``, the networks that act, in float16, and ``<name>.json``, which
describes the policy, its training and its distance in each weather. Nothing is unpickled. A new agent can learn on the
features of a driver's encoders, see :mod:`sb3_have.trained.features`.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_device

from sb3_have.checkpoint.files import write_atomically
from sb3_have.configuration import suggest
from sb3_have.export.config import MAX_SIZE, build, describe
from sb3_have.have.policies import MultiModalPolicy

FOLDER = Path(__file__).parent


class PretrainedPolicy(BasePolicy):
    """
    The part of a :class:`~sb3_have.MultiModalPolicy` that acts: encoder, actor and assignment network.

    It has no critics, so it gives actions and modality weights but no Q-values. Load it by :func:`pretrained`; SB3's
    ``save`` and ``load`` do not work with it.

    :param policy: Policy with all networks; those that act are shared with it
    :param card: Content of the driver's JSON file: ``env_id``, ``env_kwargs``, ``training`` and ``evaluation``
    """

    def __init__(self, policy: MultiModalPolicy, card: dict[str, Any]) -> None:
        super().__init__(policy.observation_space, policy.action_space, squash_output=True)
        self.card = card
        self.encoder, self.actor, self.assignment = policy.critic.encoder, policy.actor, policy.critic.assignment

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of the environment that the driver was trained in, without the weather."""
        return copy.deepcopy(self.card["env_kwargs"])

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        action: th.Tensor = self.actor(self.encoder(observation).flatten(start_dim=1), deterministic)
        return action

    def modality_weights(self, observation: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Compute the attention weights of the modalities (Eq. 9), which sum to 1.

        :param observation: One observation or a batch, as for ``predict``
        :return: An array (B,) for each modality
        """
        obs, _ = self.obs_to_tensor(observation)
        with th.no_grad():
            weights = self.assignment(self.encoder(obs)).cpu().numpy()
        return dict(zip(self.encoder.modalities, weights.T, strict=True))


def driver_names() -> list[str]:
    """Return the names of the trained drivers."""
    return sorted(file.stem for file in FOLDER.glob("*.json"))


def pretrained(name: str = "have", device: th.device | str = "auto") -> PretrainedPolicy:
    """
    Load a trained driver of ``HighwayVision-v0``::

        policy = pretrained("have")
        evaluate(policy, "HighwayVision-v0", ["HardRainNight"], env_kwargs=policy.env_kwargs)

    ``policy.card`` describes its training and how far it drives in each weather.

    :param name: "have" (RGB and events) or "have-depth" (RGB, events and depth)
    :param device: Device of the policy
    :raises ValueError: If there is no driver of this name
    """
    from safetensors.torch import load_file

    if name not in driver_names():
        raise ValueError(f"there is no driver {name!r}{suggest(name, driver_names())}")
    card = json.loads((FOLDER / f"{name}.json").read_text())
    # The random initial weights must not use up the caller's random numbers
    with th.random.fork_rng(devices=[]):
        full = build(card.pop("policy"), MAX_SIZE)
    assert isinstance(full, MultiModalPolicy)
    policy = PretrainedPolicy(full, card)
    tensors = load_file(FOLDER / f"{name}.safetensors")
    policy.load_state_dict({key: tensor.float() for key, tensor in tensors.items()})
    policy.set_training_mode(False)
    return policy.to(get_device(device))


def save_driver(policy: MultiModalPolicy, name: str, card: dict[str, Any], folder: Path = FOLDER) -> None:
    """
    Write the two files of a driver.

    :param policy: The trained policy
    :param name: Name of the driver
    :param card: ``env_id``, ``env_kwargs``, ``training`` and ``evaluation``, in JSON types
    :param folder: Folder to write to
    """
    from safetensors.torch import save_file

    acting = PretrainedPolicy(policy, card)
    tensors = {key: tensor.half().cpu().contiguous() for key, tensor in acting.state_dict().items()}
    folder.mkdir(exist_ok=True)
    write_atomically(folder / f"{name}.safetensors", lambda file: save_file(tensors, file))
    content = json.dumps({**card, "policy": describe(policy)}, indent=2) + "\n"
    write_atomically(folder / f"{name}.json", lambda file: file.write_text(content))
