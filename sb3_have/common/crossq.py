"""sb3-contrib's CrossQ for Dict observations."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch as th
from sb3_contrib import CrossQ
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_have.common.encoders import MultiModalExtractor


class MultiInputPolicy(CrossQPolicy):
    """CrossQ's policy with a features extractor for Dict observations by default; the parameters are CrossQPolicy's."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("features_extractor_class", CombinedExtractor)
        super().__init__(*args, **kwargs)


class MultiModalCrossQPolicy(CrossQPolicy):
    """
    CrossQ's policy with :class:`~sb3_have.common.encoders.MultiModalExtractor` as the default features extractor.

    :param features_extractor_class: Features extractor to use
    :param normalize_images: Whether SB3 divides images by 255; the encoders decode the bytes themselves
    """

    def __init__(
        self,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] = MultiModalExtractor,
        normalize_images: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            *args, features_extractor_class=features_extractor_class, normalize_images=normalize_images, **kwargs
        )


class MultiInputCrossQ(CrossQ):
    """
    CrossQ (Bhatt et al. 2024) that also accepts ``"MultiInputPolicy"``; the algorithm is sb3-contrib's, untouched.

    Its training step joins observations and next observations by ``torch.cat``, because the batch statistics are those
    of both. Here they come as dictionaries that ``torch.cat`` joins key by key. ``"MultiInputPolicy"`` uses SB3's
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
    """Samples of a replay buffer, their dictionaries as :class:`_JoinableDict`."""

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
    """Tensors by name that ``torch.cat`` joins key by key."""

    @classmethod
    def __torch_function__(
        cls, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if function is not th.cat:
            return NotImplemented
        first, *_ = parts = args[0]
        return cls({key: th.cat([part[key] for part in parts], *args[1:], **(kwargs or {})) for key in first})
