"""sb3-contrib's CrossQ for Dict observations."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch as th
from sb3_contrib import CrossQ
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_have.common.encoders import MultiModalExtractor


class MultiInputPolicy(CrossQPolicy):
    """CrossQPolicy with a features extractor for Dict observations by default; its parameters are the same."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", CombinedExtractor)
        super().__init__(*args, **kwargs)


class MultiModalCrossQPolicy(CrossQPolicy):
    """CrossQPolicy with :class:`~sb3_have.common.encoders.MultiModalExtractor` as the default features extractor."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs = {"features_extractor_class": MultiModalExtractor, "normalize_images": False, **kwargs}
        super().__init__(*args, **kwargs)


class MultiInputCrossQ(CrossQ):
    """
    CrossQ (Bhatt et al. 2024) with a ``"MultiInputPolicy"``; the algorithm is sb3-contrib's, unchanged.

    For the joint batch statistics, its training step concatenates observations and next observations by ``torch.cat``.
    Here they are dictionaries that ``torch.cat`` concatenates key by key. The default features extractor is SB3's
    ``CombinedExtractor``; :class:`MultiModalCrossQPolicy` uses the encoders of HAVESAC.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        **CrossQ.policy_aliases,
        "MultiInputPolicy": MultiInputPolicy,
    }

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        replay_buffer = self.replay_buffer
        assert replay_buffer is not None
        self.replay_buffer = _Joinable(replay_buffer)  # type: ignore[assignment]
        try:
            super().train(gradient_steps, batch_size)
        finally:
            self.replay_buffer = replay_buffer


class _Joinable:
    """A replay buffer whose samples hold a :class:`_JoinableDict` instead of each dictionary."""

    def __init__(self, replay_buffer: ReplayBuffer):
        self.replay_buffer = replay_buffer

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        samples = self.replay_buffer.sample(batch_size, env=env)
        if not isinstance(samples.observations, dict):
            return samples
        return samples._replace(
            observations=_JoinableDict(samples.observations),
            next_observations=_JoinableDict(samples.next_observations),
        )


class _JoinableDict(dict[str, th.Tensor]):
    """A dictionary of tensors that ``torch.cat`` concatenates key by key."""

    @classmethod
    def __torch_function__(
        cls, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if function is not th.cat:
            return NotImplemented
        first, *_ = parts = args[0]
        return cls({key: th.cat([part[key] for part in parts], *args[1:], **(kwargs or {})) for key in first})
