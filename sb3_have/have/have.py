"""HAVESAC: soft actor-critic with Hierarchical Adaptive Value Estimation."""

import io
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import polyak_update

from sb3_have.common.augmentation import check_random_shift, mean_over_copies, shifted_copies
from sb3_have.common.buffers import ModalityReplayBuffer, stacked_frames
from sb3_have.common.log_names import log_names
from sb3_have.common.validation import (
    cast_observation,
    check_action_space,
    check_observation,
    check_stored_observation,
)
from sb3_have.have.auxiliary import AuxiliaryLoss, LatentTransitions, auxiliary_classes, auxiliary_losses
from sb3_have.have.critic import MultiModalCritic, Values, drop_modalities
from sb3_have.have.policies import MultiModalPolicy

SelfHAVESAC = TypeVar("SelfHAVESAC", bound="HAVESAC")
TARGETS = ("bellman", "paper")


class HAVESAC(SAC):
    """
    Hierarchical Adaptive Value Estimation on Soft Actor-Critic (HAVE-SAC)

    Reinforcement learning for agents with several sensors: every modality of the observation has an encoder and a local
    critic. Attention weights the local values (LVE), a global critic reads the features of all modalities (GVE), and a
    hypernetwork mixes the two (re-fusion). The critic's and the auxiliary losses train the encoders in one backward
    pass; the actor reads the detached features.

    Paper: Huang et al., "Hierarchical Adaptive Value Estimation for Multi-modal Visual Reinforcement Learning",
    NeurIPS 2023, https://nips.cc/virtual/2023/poster/70701

    This implementation is written from the paper and builds on Stable-Baselines3's SAC
    (https://arxiv.org/abs/1801.01290). The auxiliary losses are those of DeepMDP (https://arxiv.org/abs/1906.02736),
    and the optional image augmentation is that of DrQ (https://arxiv.org/abs/2004.13649).

    :param policy: The policy model to use ("MultiInputPolicy", or a subclass of :class:`MultiModalPolicy`)
    :param env: The environment to learn from (if registered in Gymnasium, can be str). Its actions are a Box, its
        observations a Dict of Boxes or a single Box.
    :param learning_rate: Learning rate of the Adam optimizers of actor, critic and entropy coefficient; it can be a
        function of the current progress remaining (from 1 to 0)
    :param buffer_size: Size of the replay buffer
    :param learning_starts: How many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: The soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: The discount factor
    :param train_freq: Update the model every ``train_freq`` steps. Alternatively pass a tuple of frequency and unit
        like ``(5, "step")`` or ``(2, "episode")``.
    :param gradient_steps: How many gradient steps to do after each rollout (see ``train_freq``). ``-1`` means as many
        gradient steps as steps done in the environment during the rollout.
    :param action_noise: The action noise type (None by default), this can help for hard exploration problems
    :param replay_buffer_class: Replay buffer class to use. If ``None``, :class:`~sb3_have.ModalityReplayBuffer` for
        uint8 images and for n-step returns, and SB3's buffers otherwise.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation. The number of stacked
        frames, ``n_steps`` and ``gamma`` are filled in for a :class:`~sb3_have.ModalityReplayBuffer`.
    :param optimize_memory_usage: SB3's memory-efficient variant of its own replay buffer for Box observations;
        :class:`~sb3_have.ModalityReplayBuffer` stores every frame once anyway and refuses it.
    :param n_steps: When ``n_steps > 1``, uses n-step returns when updating the Q-value networks, for Dict observations
        too. DeepMDP then predicts n steps ahead from a single action.
    :param ent_coef: Entropy regularization coefficient. Set it to "auto" to learn it automatically (and "auto_0.1" for
        using 0.1 as initial value).
    :param target_update_interval: Gradient steps between updates of the target networks, counted across calls to
        :meth:`train` (SB3 starts counting again in every call, so its setting has no effect with
        ``gradient_steps=1``)
    :param policy_delay: Gradient steps of the critic for each one of the actor and the entropy coefficient, counted
        across calls to :meth:`train`
    :param target_entropy: Target entropy when learning ``ent_coef`` (``ent_coef="auto"``)
    :param use_sde: Whether to use generalized State-Dependent Exploration (gSDE) instead of action noise exploration
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE. Default: -1 (only sample at the
        beginning of the rollout)
    :param use_sde_at_warmup: Whether to use gSDE instead of uniform sampling during the warm-up phase (before learning
        starts)
    :param value_estimation: Short for ``policy_kwargs=dict(value_estimation=...)``. The Q-value used by the actor and
        the target: "have" (re-fusion of global and local values, the default), "lve" (weighted local values alone) or
        "gve" (global value alone), the ablations of the paper
    :param refusion: Short for ``policy_kwargs=dict(refusion=...)``. The form of the re-fusion network: "convex" (the
        default), "monotone" or "free" (the paper's), see :class:`~sb3_have.have.critic.RefusionNetwork`
    :param target: "bellman" regresses on y = r + gamma (1 - done) (min_k H'_k - alpha log pi). "paper" is Eq. 10 as
        written, which mixes both sides of the Bellman equation: y = min_k H'_k(y_g, y_l) with
        y_j = r + gamma (1 - done) (q'_j - alpha log pi). The two are equal with "convex" re-fusion and without
        re-fusion ("lve", "gve"); with "free" re-fusion the second one may diverge. The paper's method is
        ``target="paper", refusion="free", local_coef=0``, its LVE ``value_estimation="lve", local_coef=0``.
    :param local_coef: Weight of the loss that also regresses q_g, q_l and every local value on the target (0 in the
        paper)
    :param modality_dropout: Probability of zeroing a modality's features in a training sample, for critic and actor
        alike; at least one modality is always kept
    :param random_shift: Largest shift of the images of a training sample, in pixels, the same for all sensors (4 in
        DrQ), see :func:`~sb3_have.common.augmentation.random_shift`. 0 switches it off.
    :param n_augmentations: The K and M of DrQ (2 there): the number of differently shifted copies of a sample. Target
        and critic loss are averaged over them; auxiliary losses and actor use the first.
    :param auxiliary: The auxiliary losses to train, with coefficient 1: "deepmdp", None, or
        ``{name: AuxiliaryLoss class}`` (including "deepmdp" if wanted). :class:`~sb3_have.DeepMDPCallback` changes the
        coefficients.
    :param compile: Whether to compile encoders, critics and auxiliary heads with ``torch.nn.Module.compile``. This
        takes minutes and is meant for CUDA, where it has not been tried yet.
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average the
        reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments to be passed to the policy on creation, see :class:`MultiModalPolicy`
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run. Setting it to "auto", the code will be run
        on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MultiInputPolicy": MultiModalPolicy,
        "MlpPolicy": MultiModalPolicy,
        "CnnPolicy": MultiModalPolicy,
    }
    policy: MultiModalPolicy
    critic: MultiModalCritic  # type: ignore[assignment]
    critic_target: MultiModalCritic  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[MultiModalPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 100,
        batch_size: int = 256,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        policy_delay: int = 1,
        target_entropy: str | float = "auto",
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        use_sde_at_warmup: bool = False,
        value_estimation: str | None = None,
        refusion: str | None = None,
        target: str = "bellman",
        local_coef: float = 1.0,
        modality_dropout: float = 0.0,
        random_shift: int = 0,
        n_augmentations: int = 1,
        auxiliary: str | Mapping[str, type[AuxiliaryLoss]] | None = "deepmdp",
        compile: bool = False,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        given_policy_kwargs = dict(policy_kwargs or {})
        if env is not None:
            env = maybe_make_env(env, verbose)
            check_action_space(env.action_space)
        # SB3 does not accept NumPy's integers here
        if isinstance(train_freq, np.integer):
            train_freq = int(train_freq)
        elif isinstance(train_freq, tuple) and isinstance(train_freq[0], np.integer):
            train_freq = (int(train_freq[0]), train_freq[1])
        super().__init__(
            policy,
            env,  # type: ignore[arg-type]
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            use_sde_at_warmup=use_sde_at_warmup,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=dict(given_policy_kwargs),
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        # SB3 has written into the dictionary that it got
        self.policy_kwargs = given_policy_kwargs
        self.value_estimation = value_estimation
        self.refusion = refusion
        self.auxiliary = auxiliary
        self.policy_delay = policy_delay
        self.target = target
        self.local_coef = local_coef
        self.modality_dropout = modality_dropout
        self.random_shift = random_shift
        self.n_augmentations = n_augmentations
        losses = auxiliary_classes(auxiliary)
        self.auxiliary_coefs = {term: 1.0 for loss in losses.values() for term in loss.terms}
        self.compile = compile
        self.n_stack = 1
        self._architecture: dict[str, Any] | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        # Check here and not in the constructor, because `load` sets attributes in between
        if not issubclass(self.policy_class, MultiModalPolicy):
            raise ValueError(
                f"policy {self.policy_class.__name__}: HAVESAC needs a MultiModalPolicy; load a model of another "
                "algorithm with the class that saved it."
            )
        if self.target not in TARGETS:
            raise ValueError(f"target={self.target!r}: expected one of {TARGETS}.")
        if not self.local_coef >= 0:
            raise ValueError(f"local_coef={self.local_coef}: expected a number >= 0.")
        if not 0 <= self.modality_dropout < 1:
            raise ValueError(f"modality_dropout={self.modality_dropout}: expected a probability in [0, 1).")
        for name in ("buffer_size", "policy_delay", "target_update_interval"):
            if not (isinstance(number := getattr(self, name), int | np.integer) and number >= 1):
                raise ValueError(f"{name}={number!r}: expected a whole number, 1 or more.")
        check_random_shift(self.observation_space, self.random_shift, self.n_augmentations)

        # Store images, and transitions for n-step returns, in a ModalityReplayBuffer
        if self.env is not None:  # a model that is being loaded has its n_stack already
            self.n_stack = stacked_frames(self.env)
        if self.replay_buffer_class is None and (self.n_steps > 1 or has_images(self.observation_space)):
            self.replay_buffer_class = ModalityReplayBuffer
        policy_kwargs = self._full_policy_kwargs()
        given = self.n_steps, self.replay_buffer_kwargs, self.policy_kwargs
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, ModalityReplayBuffer):
            self.replay_buffer_kwargs = self._replay_buffer_kwargs()
            self.n_steps = 1  # SB3 would warn that it is ignored
        self.policy_kwargs = policy_kwargs
        super()._setup_model()
        self.n_steps, self.replay_buffer_kwargs, self.policy_kwargs = given

        if self.compile:
            for module in (*self.critic.children(), *self.critic_target.children(), *self.policy.auxiliary.values()):
                module.compile()
        if self.verbose >= 1 and has_images(self.observation_space):
            print(f"Image encoders compute in {self.critic.encoder.image_dtype(self.device)}")

    def _full_policy_kwargs(self) -> dict[str, Any]:
        """
        Merge the user's ``policy_kwargs`` with the arguments of HAVESAC that belong to the policy.

        :raises ValueError: if an argument is given twice, belongs to SAC, or differs from that of the saved model
        """
        for name in ("features_extractor_class", "features_extractor_kwargs", "share_features_extractor"):
            if name in self.policy_kwargs:
                raise ValueError(
                    f"policy_kwargs: HAVESAC has no {name}, because its critic owns an encoder for each modality; use "
                    "features_dim, modalities, encoder_classes and encoder_kwargs."
                )
        own = {
            "value_estimation": self.value_estimation,
            "refusion": self.refusion,
            "auxiliary_losses": auxiliary_classes(self.auxiliary),
        }
        own = {name: value for name, value in own.items() if value is not None}
        for name, value in own.items():
            if self.policy_kwargs.get(name, value) != value:
                raise ValueError(
                    f"policy_kwargs has {name}={self.policy_kwargs[name]!r}, but HAVESAC's argument of that name"
                    f"{' (auxiliary)' if name == 'auxiliary_losses' else ''} is {value!r}: give it once."
                )
        # `load` overwrites attributes of a saved model by its keyword arguments
        if self._architecture is not None and own != self._architecture:
            changed = [name for name in own | self._architecture if own.get(name) != self._architecture.get(name)]
            raise ValueError(
                f"load: {', '.join(changed)} cannot be changed, because the saved networks depend on it; the model was "
                f"saved with {self._architecture}."
            )
        self._architecture = own
        return {**self.policy_kwargs, **own, "use_sde": self.use_sde}

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]

        # Update learning rate according to lr schedule
        self._update_learning_rate(optimizers)

        actor_parameters = [parameter for parameter in self.actor.parameters() if parameter.requires_grad]
        critic_parameters: list[th.Tensor] = list(self.critic.parameters())
        target_parameters: list[th.Tensor] = list(self.critic_target.parameters())
        assert isinstance(self.target_entropy, float)  # for the type checker

        actor_losses, critic_losses = list[th.Tensor](), list[th.Tensor]()
        ent_coefs, ent_coef_losses = list[th.Tensor](), list[th.Tensor]()
        aux_losses: dict[str, list[th.Tensor]] = {}

        # Values, rewards and targets have the shape (B,), those of the twins (K, B)
        for _ in range(gradient_steps):
            self._n_updates += 1

            # Sample replay buffer
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            # Augment the images (DrQ): the shifted copies of the batch follow one another
            if self.random_shift > 0:
                replay_data = shifted_copies(replay_data, self.random_shift, self.n_augmentations)
            # For n-step returns, the discount factor is gamma**n_steps (when no early termination)
            discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma

            # Encode every observation once: the features of the target encoder serve the target, DeepMDP and the next
            # action, because encoding next observations by the critic's encoder too would take 11 to 23% longer.
            # Critic and actor read features with dropout, auxiliary losses and the target those without
            features = self.policy.encode(replay_data.observations)
            with th.no_grad():
                next_features = self.critic_target.encoder(replay_data.next_observations)
            critic_features = drop_modalities(features, self.modality_dropout)

            # We need to sample because `log_std` may have changed between two gradient steps
            if self.use_sde:
                self.actor.reset_noise()

            # Important: detach the variable from the graph so we don't change it with other losses
            ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
            ent_coefs.append(ent_coef)

            with th.no_grad():
                # Select action according to policy
                next_actions, next_log_prob = self.actor.action_log_prob(next_features.flatten(start_dim=1))
                # Add the entropy term
                entropy_bonus = -ent_coef * next_log_prob
                # Compute the target Q-values (Eq. 8, or Eq. 10): min over all critics
                rewards, not_done = replay_data.rewards.squeeze(1), 1 - replay_data.dones.squeeze(1)
                discounts = (discounts.squeeze(1) if isinstance(discounts, th.Tensor) else discounts) * not_done
                target_q = self._target_values(next_features, next_actions, rewards, discounts, entropy_bonus)
                if self.n_augmentations > 1:
                    target_q = mean_over_copies(target_q, self.n_augmentations)

            # Get the current Q-values (Eq. 6, Eq. 9, section 3.4), using actions from the replay buffer
            values = self.critic.values(critic_features, replay_data.actions)

            # Compute critic loss
            critic_loss = self._critic_loss(values, target_q)
            critic_losses.append(critic_loss.detach())

            # Add the auxiliary losses (Eq. 12) on the same features, of the first copy of the batch
            loss = critic_loss
            latent = (features, replay_data.actions, replay_data.rewards, next_features, replay_data.dones)
            transitions = LatentTransitions(*(tensor[:batch_size] for tensor in latent))
            for term, aux_loss in auxiliary_losses(self.policy.auxiliary, transitions, self.auxiliary_coefs).items():
                loss = loss + self.auxiliary_coefs[term] * aux_loss
                aux_losses.setdefault(term, []).append(aux_loss.detach())

            # Optimize the critic, with the encoders and the auxiliary heads
            self.critic.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.critic.optimizer.step()

            if self._n_updates % self.policy_delay == 0:
                # Action by the current actor for the sampled state, from detached features of before the critic's step
                actor_features = critic_features[:batch_size].detach()
                actions_pi, log_prob = self.actor.action_log_prob(actor_features.flatten(start_dim=1))

                # Optimize entropy coefficient, also called entropy temperature or alpha in the paper
                if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                    ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                    ent_coef_losses.append(ent_coef_loss.detach())
                    self.ent_coef_optimizer.zero_grad()
                    ent_coef_loss.backward()  # type: ignore[no-untyped-call]
                    self.ent_coef_optimizer.step()

                # Compute actor loss (Eq. 11): min over all critics after mixing
                min_q_pi = self.critic.min_q(actor_features, actions_pi)
                actor_loss = (ent_coef * log_prob - min_q_pi).mean()
                actor_losses.append(actor_loss.detach())

                # Optimize the actor. `actor_loss.backward()` would also compute gradients of the critic: 16 ms instead
                # of 12, in an update of 246 ms (64 px, one core of an AMD Zen 3)
                gradients = th.autograd.grad(actor_loss, actor_parameters, allow_unused=True)
                for parameter, gradient in zip(actor_parameters, gradients, strict=True):
                    parameter.grad = gradient
                self.actor.optimizer.step()

            # Update target networks: encoder, all critics, assignment and re-fusion. One call for all parameters takes
            # 0.9 ms, `polyak_update` 1.7 ms
            if self._n_updates % self.target_update_interval == 0:
                with th.no_grad():
                    th._foreach_lerp_(target_parameters, critic_parameters, self.tau)
                # Copy running stats, see SB3's issue #996
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

        # Drop the graph of the last batch: `copy.deepcopy(policy)` fails for tensors that have one
        for name, value in vars(self.actor.action_dist).items():
            if isinstance(value, th.Tensor):
                setattr(self.actor.action_dist, name, value.detach())
            elif isinstance(value, th.distributions.Distribution):
                setattr(self.actor.action_dist, name, None)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if critic_losses:
            self.logger.record("train/ent_coef", self._mean(ent_coefs))
            self.logger.record("train/critic_loss", self._mean(critic_losses))
        if actor_losses:
            self.logger.record("train/actor_loss", self._mean(actor_losses))
        if ent_coef_losses:
            self.logger.record("train/ent_coef_loss", self._mean(ent_coef_losses))
        names = log_names(aux_losses, 24)
        for term, losses in aux_losses.items():
            self.logger.record(f"train/aux_{names[term]}_loss", self._mean(losses))

    def _mean(self, losses: Sequence[th.Tensor]) -> float | th.Tensor:
        """``.item()`` synchronises the GPU, so there the mean stays a tensor until logs are dumped."""
        mean = th.stack(tuple(losses)).mean()
        return mean.item() if self.device.type == "cpu" else mean

    def dump_logs(self) -> None:
        for name, value in self.logger.name_to_value.items():
            if isinstance(value, th.Tensor) and value.dim() == 0:
                self.logger.name_to_value[name] = value.item()
        super().dump_logs()

    def _target_values(
        self,
        next_features: th.Tensor,
        next_actions: th.Tensor,
        rewards: th.Tensor,
        discounts: th.Tensor,
        entropy_bonus: th.Tensor,
    ) -> th.Tensor:
        """
        Compute the regression target y (B,): the Bellman target (Eq. 8), or Eq. 10 with ``target="paper"``.

        :param next_features: (B, d, F) by the target encoder
        :param next_actions: (B, A) by the actor
        :param rewards: (B,)
        :param discounts: (B,) gamma, 0 where the episode ended
        :param entropy_bonus: (B,) -alpha log pi(a'|z')
        """
        if self.target == "paper" and self.critic_target.value_estimation == "have":
            values = self.critic_target.values(next_features, next_actions)
            target_global = rewards + discounts * (values.q_global + entropy_bonus)  # type: ignore[operator]
            target_lve = rewards + discounts * (values.q_lve + entropy_bonus)  # type: ignore[operator]
            mixed: th.Tensor = self.critic_target.refusion(target_global, target_lve, next_features)
            return mixed.min(dim=0).values  # Eq. 10
        return rewards + discounts * (self.critic_target.min_q(next_features, next_actions) + entropy_bonus)  # Eq. 8

    def _critic_loss(self, values: Values, target_q: th.Tensor) -> th.Tensor:
        """
        Compute the squared error of the Q-value and, times ``local_coef``, of its parts: q_g, q_l, and the mean over
        the modalities of q_i. It is halved and summed over
        the twins, as in SB3, whose ``critic_loss`` has the first term alone. The paper has no loss of the parts.

        :param values: the critic's values at the sampled actions
        :param target_q: (B,)
        """

        def squared_error(q: th.Tensor) -> th.Tensor:
            return 0.5 * (q - target_q).square().mean(dim=tuple(range(1, q.dim()))).sum()

        loss = squared_error(values.q)
        if self.local_coef > 0:
            parts = [values.q_local]
            if self.critic.value_estimation == "have":
                parts += [values.q_global, values.q_lve]
            loss = loss + self.local_coef * sum(squared_error(part) for part in parts if part is not None)
        return loss

    def modality_weights(self, observation: np.ndarray | dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """
        Compute the attention weights of the modalities (Eq. 9), which sum to 1.

        :param observation: one observation or a batch, as for ``predict``
        :return: an array (B,) for each modality
        :raises ValueError: with ``value_estimation="gve"``, which has no weights
        """
        return self.policy.modality_weights(observation)

    def learn(
        self: SelfHAVESAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "HAVESAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfHAVESAC:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if any(type(part).__name__ == "ParallelTrainCallback" for part in flat_callbacks(callback)):
            raise ValueError(
                "ParallelTrainCallback (rl_zoo3) trains a copy of the model as SAC, which cannot use a "
                "MultiModalPolicy: leave it out."
            )
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        assert self._last_obs is not None
        check_observation(self._last_obs, self.observation_space)
        if self._vec_normalize_env is not None:
            assert self._last_original_obs is not None
            check_stored_observation(self._last_original_obs, self.observation_space)
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Refuse NaN before it reaches the replay buffer, from where it would silently spoil the networks."""
        # After an episode's end, new_obs is the first observation of the next one
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = cast_observation(info["terminal_observation"], self.observation_space)
        last_observations = [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        for observation in [new_obs, *last_observations]:
            check_observation(observation, self.observation_space)
        if not np.isfinite(reward).all():
            raise ValueError(
                f"reward: got {reward} at step {self.num_timesteps}, expected finite numbers; fix the environment's "
                "reward function (SB3's VecCheckNan shows where it comes from)."
            )
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def _replay_buffer_kwargs(self) -> dict[str, Any]:
        """Return the arguments of a ModalityReplayBuffer: the user's, and those that follow from the environment."""
        return {"n_stack": self.n_stack, "n_steps": self.n_steps, "gamma": self.gamma, **self.replay_buffer_kwargs}

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a replay buffer from a pickle file.

        :param path: Path to the pickled replay buffer
        :param truncate_last_traj: Whether the last trajectory ends where the buffer was saved. Use False if the
            environment continues from there.
        """
        before = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        assert loaded is not None
        expected = {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "n_envs": self.n_envs,
            "n_stack": self.n_stack,
        }
        for name, value in expected.items():
            if getattr(loaded, name, value) != value:
                self.replay_buffer = before
                raise ValueError(
                    f"the replay buffer in {path} has {name} {getattr(loaded, name)}, the model {value}: load it "
                    "into a model with the same environments."
                )
        if isinstance(self.replay_buffer, ModalityReplayBuffer):
            kwargs = self._replay_buffer_kwargs()
            self.replay_buffer.n_steps, self.replay_buffer.gamma = kwargs["n_steps"], kwargs["gamma"]
            if truncate_last_traj:
                self.replay_buffer.truncate_last_trajectory()


def flat_callbacks(callback: MaybeCallback) -> list[Any]:
    """List a callback, or the callbacks of a list, and all that they contain."""
    parts = callback if isinstance(callback, list) else getattr(callback, "callbacks", None)
    if parts is not None:
        return [inner for part in parts for inner in flat_callbacks(part)]
    child = getattr(callback, "callback", None)
    return [callback, *(flat_callbacks(child) if isinstance(child, BaseCallback) else [])]


def has_images(space: spaces.Space[Any]) -> bool:
    """Whether an observation space, or one of its keys, is a uint8 image."""
    return any(map(is_image_space, space.spaces.values() if isinstance(space, spaces.Dict) else [space]))
