"""
The critic of HAVE: local critics per modality weighted by attention (LVE), a global critic on the fused features (GVE),
and a hypernetwork that mixes the two depending on the state (re-fusion).

Shapes: B batch, K critics (twins), d modalities, F features per modality, A action dimensions.
Features z are (B, d, F); the global features z_g are their concatenation (B, d*F).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_have.common.encoders import MultiModalEncoder
from sb3_have.common.networks import ParallelMLP

VALUE_ESTIMATIONS = ("have", "lve", "gve")
REFUSIONS = ("convex", "monotone", "free")


class Values(NamedTuple):
    """The Q-values of a batch and their parts; a part that ``value_estimation`` does not use is None."""

    q: th.Tensor
    """(K, B): The Q-value used by the actor and the target, H(q_g, q_l) for "have"."""
    q_global: th.Tensor | None
    """(K, B): q_g, the global value."""
    q_local: th.Tensor | None
    """(K, d, B): q_i, the local values."""
    q_lve: th.Tensor | None
    """(K, B): q_l, the weighted sum of the local values (Eq. 6)."""
    weights: th.Tensor | None
    """(B, d): w, the weights of the modalities (Eq. 9)."""


class LocalCritics(nn.Module):
    """
    One critic per modality and twin, Q_i^k(z_i, a): features (B, d, F) and actions (B, A) to values (K, d, B).

    :param n_modalities: Number of modalities (d)
    :param features_dim: Number of features of each modality (F)
    :param action_dim: Number of action dimensions (A)
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Activation function
    :param n_critics: Number of critics for each modality (K)
    """

    def __init__(
        self,
        n_modalities: int,
        features_dim: int,
        action_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 2,
    ):
        super().__init__()
        self.shape = (n_critics, n_modalities)
        self.net = ParallelMLP(n_critics * n_modalities, features_dim + action_dim, 1, net_arch, activation_fn)

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        n_critics, n_modalities = self.shape
        inputs = th.cat([features, actions.unsqueeze(1).expand(-1, n_modalities, -1)], dim=2)
        inputs = inputs.transpose(0, 1).repeat(n_critics, 1, 1)  # (K * d, B, F + A)
        return self.net(inputs).view(n_critics, n_modalities, -1)  # type: ignore[no-any-return]


class GlobalCritic(nn.Module):
    """
    Twin critics on the concatenated features, Q_g^k(z_g, a): (B, d, F) and (B, A) to (K, B).

    :param n_modalities: Number of modalities (d)
    :param features_dim: Number of features of each modality (F)
    :param action_dim: Number of action dimensions (A)
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Activation function
    :param n_critics: Number of critics (K)
    """

    def __init__(
        self,
        n_modalities: int,
        features_dim: int,
        action_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 2,
    ):
        super().__init__()
        self.n_critics = n_critics
        self.net = ParallelMLP(n_critics, n_modalities * features_dim + action_dim, 1, net_arch, activation_fn)

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat([features.flatten(start_dim=1), actions], dim=1).expand(self.n_critics, -1, -1)
        return self.net(inputs).squeeze(2)  # type: ignore[no-any-return]


class AssignmentNetwork(nn.Module):
    """
    Attention of the fused features over the modalities: features (B, d, F) to weights (B, d), which are positive and
    sum to 1.

    Eq. 9: w = softmax_i((W_q z_g) . (W_k z_i) / sqrt(p)).

    :param n_modalities: Number of modalities (d)
    :param features_dim: Number of features of each modality (F)
    :param attention_dim: Size of queries and keys (p)
    """

    def __init__(self, n_modalities: int, features_dim: int, attention_dim: int = 32):
        super().__init__()
        self.query = nn.Linear(n_modalities * features_dim, attention_dim, bias=False)
        self.key = nn.Linear(features_dim, attention_dim, bias=False)

    def forward(self, features: th.Tensor) -> th.Tensor:
        query = self.query(features.flatten(start_dim=1)).unsqueeze(2)  # (B, p, 1)
        scores = (self.key(features) @ query).squeeze(2) / math.sqrt(query.shape[1])
        return F.softmax(scores, dim=1)  # Eq. 9


class RefusionNetwork(nn.Module):
    """
    H(q_g, q_l; z_g), whose weights are outputs of hypernetworks on the fused features (section 3.4): (K, B), (K, B) and
    (B, d, F) to (K, B).

    - "convex": H = b_g q_g + b_l q_l, (b_g, b_l) = softmax of a linear layer of z_g, without state bias. The
      gradients in q_g and q_l are positive (Remark 1), and mixing both sides of the Bellman equation (Eq. 10)
      changes nothing.
    - "monotone": a two-layer perceptron on (q_g, q_l). One linear layer each computes its weights and biases, and
      softplus makes the weights positive, so that the gradients are positive too. The activations are leaky ReLUs
      because ELUs go flat where values are far below zero.
    - "free": the same without the constraint, as in the paper.

    :param n_modalities: Number of modalities (d)
    :param features_dim: Number of features of each modality (F)
    :param refusion: "convex", "monotone" or "free"
    :param hidden_dim: Number of hidden units of "monotone" and "free"
    """

    def __init__(self, n_modalities: int, features_dim: int, refusion: str = "convex", hidden_dim: int = 8):
        super().__init__()
        self.refusion = refusion
        self.hidden_dim = hidden_dim
        n_inputs = n_modalities * features_dim
        if refusion == "convex":
            self.gate = nn.Linear(n_inputs, 2)
            # Start with weights of about one half each
            nn.init.normal_(self.gate.weight, std=1e-2)
            nn.init.zeros_(self.gate.bias)
        else:
            self.hyper_w1 = nn.Linear(n_inputs, 2 * hidden_dim)
            self.hyper_b1 = nn.Linear(n_inputs, hidden_dim)
            self.hyper_w2 = nn.Linear(n_inputs, hidden_dim)
            self.hyper_b2 = nn.Linear(n_inputs, 1)

    def forward(self, q_global: th.Tensor, q_lve: th.Tensor, features: th.Tensor) -> th.Tensor:
        z = features.flatten(start_dim=1)
        q = th.stack([q_global, q_lve], dim=2)  # (K, B, 2)
        if self.refusion == "convex":
            gate = F.softmax(self.gate(z), dim=1)
            return (q * gate).sum(dim=2)
        w1 = self.hyper_w1(z).view(-1, 2, self.hidden_dim)
        w2 = self.hyper_w2(z)
        if self.refusion == "monotone":
            w1, w2 = F.softplus(w1), F.softplus(w2) / self.hidden_dim
        hidden = th.einsum("kbq,bqh->kbh", q, w1) + self.hyper_b1(z)
        mixed: th.Tensor = (F.leaky_relu(hidden, 0.1) * w2).sum(dim=2) + self.hyper_b2(z).squeeze(1)
        return mixed


class MultiModalCritic(BaseModel):
    """
    Critic network(s) of HAVE: encoder, local critics, assignment network, global critic and re-fusion network.

    ``critic(obs, actions)`` returns one tensor (B, 1) for each of the K critics, as SB3's critics do.

    :param observation_space: Observation space of the policy
    :param action_space: Action space
    :param encoder: Network from raw observations to features (B, d, F); the critic owns it
    :param net_arch: Widths of the hidden layers of every local and global critic
    :param activation_fn: Activation function
    :param n_critics: Number of critic networks to create (K)
    :param value_estimation: The Q-value: "have" is H(q_g, q_l), "lve" is q_l and "gve" is q_g; the networks that are
        not needed are not created
    :param refusion: The form of H, see :class:`RefusionNetwork`
    :param attention_dim: Size of the queries and keys of the assignment network (p in Eq. 9)
    :raises ValueError: for an unknown ``value_estimation`` or ``refusion``
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        encoder: MultiModalEncoder,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 2,
        value_estimation: str = "have",
        refusion: str = "convex",
        attention_dim: int = 32,
    ):
        super().__init__(observation_space, action_space, normalize_images=encoder.normalize_images)
        if value_estimation not in VALUE_ESTIMATIONS:
            raise ValueError(f"value_estimation={value_estimation!r}: expected one of {VALUE_ESTIMATIONS}.")
        if refusion not in REFUSIONS:
            raise ValueError(f"refusion={refusion!r}: expected one of {REFUSIONS}.")
        self.value_estimation = value_estimation
        self.n_critics = n_critics
        self.encoder = encoder
        n_modalities, features_dim = len(encoder.modalities), encoder.features_dim
        heads = (n_modalities, features_dim, get_action_dim(action_space), net_arch, activation_fn, n_critics)
        if value_estimation != "gve":
            self.local_critics = LocalCritics(*heads)
            self.assignment = AssignmentNetwork(n_modalities, features_dim, attention_dim)
        if value_estimation != "lve":
            self.global_critic = GlobalCritic(*heads)
        if value_estimation == "have":
            self.refusion = RefusionNetwork(n_modalities, features_dim, refusion)

    def values(self, features: th.Tensor, actions: th.Tensor) -> Values:
        """
        Compute the Q-values and their parts. The twins share the weights of the modalities.

        :param features: (B, d, F)
        :param actions: (B, A), scaled to [-1, 1]
        """
        if self.value_estimation == "gve":
            q_global = self.global_critic(features, actions)
            return Values(q_global, q_global, None, None, None)
        q_local = self.local_critics(features, actions)
        weights = self.weights(features)
        q_lve = (q_local * weights.t()).sum(dim=1)  # Eq. 6
        if self.value_estimation == "lve":
            return Values(q_lve, None, q_local, q_lve, weights)
        q_global = self.global_critic(features, actions)
        q = self.refusion(q_global, q_lve, features)  # section 3.4
        return Values(q, q_global, q_local, q_lve, weights)

    def min_q(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Return the minimum over the twins after mixing (B,), as used by the actor and the target."""
        return self.values(features, actions).q.min(dim=0).values

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        return tuple(self.values(self.encoder(obs), actions).q.unsqueeze(2))

    def q1_forward(self, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Return the values (B, 1) of the first critic only, as in SB3."""
        return self(obs, actions)[0]  # type: ignore[no-any-return]

    def weights(self, features: th.Tensor) -> th.Tensor:
        """Compute the weights of the modalities (B, d) from features (B, d, F), Eq. 9."""
        if self.value_estimation == "gve":
            raise ValueError('value_estimation="gve" has no weights of modalities: train with "have" or "lve".')
        return self.assignment(features)  # type: ignore[no-any-return]

    def decompose(self, obs: PyTorchObs, actions: th.Tensor) -> dict[str, th.Tensor]:
        """
        Return the Q-value and its parts, to study them: ``q`` (K, B) and, where they exist, ``q_global`` (K, B),
        ``q_local`` (K, d, B), ``q_lve`` (K, B) and ``weights`` (B, d).

        :param obs: Raw observations, as :meth:`forward` takes them
        :param actions: (B, A), scaled to [-1, 1]
        """
        values = self.values(self.encoder(obs), actions)
        return {name: value for name, value in values._asdict().items() if value is not None}


def drop_modalities(features: th.Tensor, probability: float) -> th.Tensor:
    """
    Zero the features of each modality of each sample at random, but always keep at least one modality.

    :param features: (B, d, F)
    :param probability: Probability of zeroing, in [0, 1)
    """
    if probability == 0:
        return features
    batch_size, n_modalities, _ = features.shape
    kept = th.rand(batch_size, n_modalities, device=features.device) >= probability
    spared = th.randint(n_modalities, (batch_size, 1), device=features.device)
    kept |= ~kept.any(dim=1, keepdim=True) & th.zeros_like(kept).scatter_(1, spared, True)
    return features * kept.unsqueeze(2)
