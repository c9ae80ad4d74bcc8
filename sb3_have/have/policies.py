"""MultiModalPolicy: encoder, actor, MultiModalCritic, its target, and the heads of the auxiliary losses."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn
from torch.distributions import Normal

from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.common.validation import check_observation
from sb3_have.have.auxiliary import AuxiliaryLoss, draw_as_deepmdp
from sb3_have.have.critic import MultiModalCritic

SelfGaussian = TypeVar("SelfGaussian", bound="SquashedGaussian")


class MultiModalPolicy(SACPolicy):
    """
    Policy class (with actor, critic and auxiliary heads) for HAVESAC, for Dict observations (images and vectors mixed)
    or a single Box.

    The critic owns the encoder, and the critic's and the auxiliary losses train it. The actor is SB3's and reads the
    detached features, so ``policy.actor`` takes features (B, d*F), while ``policy(obs)`` and ``policy.predict(obs)``
    take observations. SB3's ``share_features_extractor=True`` does the reverse: it trains the encoder with the actor
    loss.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule (could be constant)
    :param net_arch: The specification of the actor and critic networks, as in SB3: a list, or
        ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation function
    :param use_sde: Whether to use State-Dependent Exploration or not
    :param log_std_init: Initial value for the log standard deviation
    :param use_expln: Use ``expln()`` function instead of ``exp()`` when using gSDE to ensure a positive standard
        deviation
    :param clip_mean: Clip the mean output when using gSDE to avoid numerical instability
    :param normalize_images: Whether to decode uint8 images, see :class:`~sb3_have.common.encoders.MultiModalEncoder`
    :param optimizer_class: The optimizer to use, ``th.optim.Adam`` by default
    :param optimizer_kwargs: Additional keyword arguments, excluding the learning rate, to pass to the optimizer
    :param n_critics: Number of critic networks to create
    :param features_dim: Number of features of each modality (F)
    :param modalities: The observation keys of each modality; by default every key is a modality
    :param encoder_classes: Custom encoder classes for some modalities
    :param encoder_kwargs: Keyword arguments for the encoders of some modalities
    :param signed_keys: Image keys that hold signed counts around 128; by default those with "event" in their name
    :param precision: Arithmetic of the image encoders: "auto", "float32" or "bfloat16"
    :param fusion: Fusion of feature maps between the encoders: "concat" (none), "transfuser", "efnet", or a custom
        class, see :mod:`sb3_have.common.fusion`
    :param fusion_kwargs: Keyword arguments for the fusion, and ``stages``, the convolutions after which it is applied
    :param channels_first: Whether to read images as (channels, height, width) even if their shape is ambiguous
    :param value_estimation: "have", "lve" or "gve", see :class:`~sb3_have.have.critic.MultiModalCritic`
    :param refusion: "convex", "monotone" or "free", see :class:`~sb3_have.have.critic.RefusionNetwork`
    :param attention_dim: Size of the queries and keys of the assignment network (p in Eq. 9)
    :param auxiliary_losses: Auxiliary losses by name; none by default
    """

    critic: MultiModalCritic  # type: ignore[assignment]
    critic_target: MultiModalCritic  # type: ignore[assignment]
    critic_class: ClassVar[type[MultiModalCritic]] = MultiModalCritic

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        use_sde: bool = False,
        log_std_init: float = -3,
        use_expln: bool = False,
        clip_mean: float = 2.0,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        features_dim: int = 50,
        modalities: Mapping[str, Sequence[str]] | None = None,
        encoder_classes: Mapping[str, type[nn.Module]] | None = None,
        encoder_kwargs: Mapping[str, Mapping[str, Any]] | None = None,
        signed_keys: Sequence[str] | None = None,
        precision: str = "auto",
        fusion: str | type[nn.Module] = "concat",
        fusion_kwargs: Mapping[str, Any] | None = None,
        channels_first: bool = False,
        value_estimation: str = "have",
        refusion: str = "convex",
        attention_dim: int = 32,
        auxiliary_losses: Mapping[str, type[AuxiliaryLoss]] | None = None,
    ):
        self.encoder_kwargs: dict[str, Any] = {
            "features_dim": features_dim,
            "modalities": modalities,
            "encoder_classes": encoder_classes,
            "encoder_kwargs": encoder_kwargs,
            "signed_keys": signed_keys,
            "precision": precision,
            "fusion": fusion,
            "fusion_kwargs": fusion_kwargs,
            "channels_first": channels_first,
        }
        self.value_kwargs: dict[str, Any] = {
            "value_estimation": value_estimation,
            "refusion": refusion,
            "attention_dim": attention_dim,
        }
        self.auxiliary_losses: dict[str, type[AuxiliaryLoss]] = dict(auxiliary_losses or {})
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch,
            activation_fn,
            use_sde,
            log_std_init,
            use_expln,
            clip_mean,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            n_critics=n_critics,
        )

    def _build(self, lr_schedule: Schedule) -> None:
        self.critic = self.make_critic()
        self.critic_target = self.make_critic()
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        self.critic_target.set_training_mode(False)

        encoder = self.critic.encoder
        sizes = (len(encoder.modalities), encoder.features_dim, get_action_dim(self.action_space))
        terms = [term for loss_class in self.auxiliary_losses.values() for term in loss_class.terms]
        doubled = {term for term in terms if terms.count(term) > 1}
        if doubled:
            raise ValueError(
                f"auxiliary losses {list(self.auxiliary_losses)}: more than one has the terms {sorted(doubled)}; "
                "rename them."
            )
        # The same seed gives the same initial actor with and without DeepMDP
        if "deepmdp" not in self.auxiliary_losses:
            draw_as_deepmdp(*sizes)
        self.auxiliary = nn.ModuleDict({name: loss_class(*sizes) for name, loss_class in self.auxiliary_losses.items()})

        self.actor = self.make_actor()
        self.actor.optimizer = self._make_optimizer(list(self.actor.parameters()), lr_schedule)
        critic_parameters = [*self.critic.parameters(), *self.auxiliary.parameters()]
        self.critic.optimizer = self._make_optimizer(critic_parameters, lr_schedule)

    def _make_optimizer(self, parameters: list[nn.Parameter], lr_schedule: Schedule) -> th.optim.Optimizer:
        kwargs = dict(self.optimizer_kwargs)
        if self.optimizer_class is th.optim.Adam and not {"foreach", "differentiable"} & kwargs.keys():
            kwargs.setdefault("fused", True)  # one kernel for all parameters
        return self.optimizer_class(parameters, lr=lr_schedule(1), **kwargs)  # type: ignore[call-arg]

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> MultiModalCritic:  # type: ignore[override]
        encoder = MultiModalEncoder(
            self.observation_space,
            normalize_images=self.normalize_images,
            **self.encoder_kwargs,
        )
        return self.critic_class(
            self.observation_space,
            self.action_space,  # type: ignore[arg-type]
            encoder,
            net_arch=get_actor_critic_arch(self.net_arch)[1],
            activation_fn=self.activation_fn,
            n_critics=self.critic_kwargs["n_critics"],  # type: ignore[arg-type]
            **self.value_kwargs,
        ).to(self.device)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        """SB3's actor, on the space of the concatenated features z_g."""
        features_dim = len(self.critic.encoder.modalities) * self.critic.encoder.features_dim
        latent_space = spaces.Box(-np.inf, np.inf, (features_dim,), np.float32)
        actor_kwargs: dict[str, Any] = {**self.actor_kwargs, "observation_space": latent_space}
        actor = Actor(features_extractor=FlattenExtractor(latent_space), features_dim=features_dim, **actor_kwargs)
        if not actor.use_sde:
            actor.action_dist = SquashedGaussian(get_action_dim(self.action_space))  # type: ignore[assignment]
        return actor.to(self.device)

    def encode(self, obs: PyTorchObs) -> th.Tensor:
        """Features (B, d, F) of raw observations (as tensors, with batch dimension)."""
        return self.critic.encoder(obs)  # type: ignore[no-any-return]

    def modality_weights(self, observation: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Compute the attention weights of the modalities (Eq. 9), which sum to 1.

        :param observation: one observation or a batch, as for ``predict``
        :return: an array (B,) for each modality
        :raises ValueError: with ``value_estimation="gve"``, which has no weights
        """
        self.set_training_mode(False)
        obs, _ = self.obs_to_tensor(observation)
        with th.no_grad():
            weights = self.critic.weights(self.encode(obs)).cpu().numpy()
        return dict(zip(self.critic.encoder.modalities, weights.T, strict=True))

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self.actor(self.encode(observation).detach().flatten(start_dim=1), deterministic)  # type: ignore[no-any-return]

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        check_observation(observation, self.observation_space)
        return super().obs_to_tensor(observation)

    def set_training_mode(self, mode: bool) -> None:
        super().set_training_mode(mode)  # actor and critic; the target always stays in evaluation mode
        self.auxiliary.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        del data["features_extractor_class"], data["features_extractor_kwargs"]
        data.update(**self.encoder_kwargs, **self.value_kwargs, auxiliary_losses=self.auxiliary_losses)
        return data


class SquashedGaussian(SquashedDiagGaussianDistribution):
    """SB3's distribution without PyTorch's check for NaN on a GPU, which would synchronise it in every step."""

    def proba_distribution(self: SelfGaussian, mean_actions: th.Tensor, log_std: th.Tensor) -> SelfGaussian:
        validate_args = None if mean_actions.device.type == "cpu" else False
        self.distribution = Normal(mean_actions, log_std.exp(), validate_args=validate_args)
        return self


MultiInputPolicy = MultiModalPolicy
