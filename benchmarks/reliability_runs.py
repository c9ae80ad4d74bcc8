"""One run of the reliability benchmark: train a method with HAVESAC on ReliabilityDrive-v0 and measure it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from benchmarks.distributional import FROM_REWARDS, SYMLOG, DistributionalHAVESAC
from benchmarks.known_q import Floats, auc, negative_gradient
from benchmarks.reliability_vec_env import ReliabilityDriveVecEnv
from sb3_have import HAVESAC
from sb3_have.envs.reliability_drive import CONDITIONS

# Arguments of HAVESAC per method; all others are the same
METHODS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "gve": {"value_estimation": "gve"},
        "gve-wide": {"value_estimation": "gve"},  # and wider hidden layers, see `gve_width`
        "lve": {"value_estimation": "lve"},
        "have": {},
        "have-dropout": {"modality_dropout": 0.2},
        "have-unsupervised": {"local_coef": 0.0},
        "have-monotone": {"refusion": "monotone"},
        "lve-unsupervised": {"value_estimation": "lve", "local_coef": 0.0},
        "gve-wide-dropout": {"value_estimation": "gve", "modality_dropout": 0.2},
    }
)
# Other settings, for benchmarks/STUDY.md
VARIANTS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "have-coef-0.25": {"local_coef": 0.25},
        "have-coef-4": {"local_coef": 4.0},
        "have-dropout-0.1": {"modality_dropout": 0.1},
        "have-dropout-0.4": {"modality_dropout": 0.4},
        "lve-dropout": {"value_estimation": "lve", "modality_dropout": 0.2},
    }
)
# Arguments of DistributionalHAVESAC per method, see benchmarks.distributional
DISTRIBUTIONAL: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "have-distributional": {},
        "lve-distributional": {"value_estimation": "lve"},
        "gve-wide-distributional": {"value_estimation": "gve"},
        "have-distributional-rewards": {"policy_kwargs": {"atoms": FROM_REWARDS}},
        "have-distributional-symlog": {"policy_kwargs": {"atoms": SYMLOG}},
    }
)
# Variants whose results are kept; their code was removed after commit 16a9471, because they showed no gain
REMOVED = (
    "have-min-before",
    "have-detached-keys",
    "have-temperature-2",
    "have-flat",
    "have-residual",
    "have-competing",
)
N_MODALITIES = 3
N_ENVS = 8
# Updates per step of all environments
UPDATES_PER_STEP = 4
# Steps of all environments with random actions
WARM_UP = 100
WIDTH = 64
HYPERPARAMETERS: Mapping[str, Any] = MappingProxyType(
    {
        "learning_rate": 1e-3,
        "gamma": 0.98,
        "tau": 0.01,
        "batch_size": 64,
        "buffer_size": 50_000,
        "policy_delay": 2,
        "ent_coef": "auto_0.1",
        "auxiliary": None,
        "train_freq": 1,
        "gradient_steps": UPDATES_PER_STEP,
        "learning_starts": WARM_UP * N_ENVS,
    }
)
N_EVALUATIONS = 8
# Episodes of an evaluation, which run at once and are the same for every method and training seed
N_EPISODES = 24
EVALUATION_SEED = 1_000_000
N_GRADIENT_SAMPLES = 2000
FAILURES = CONDITIONS[1:]


@dataclass
class Drive:
    """
    N episodes of a policy with S steps each; steps after the end of an episode are masked.

    :param rewards: Rewards, 0 after the end, (S, N)
    :param alive: Whether the step belongs to the episode, (S, N)
    :param reliable: Whether each modality was reliable when the action was chosen, (S, N, d)
    :param weights: Weights of the modalities, (S, N, d), or None if the method has none
    """

    rewards: Floats
    alive: NDArray[np.bool_]
    reliable: NDArray[np.bool_]
    weights: Floats | None

    @property
    def returns(self) -> Floats:
        """Return of each episode, (N,)."""
        total: Floats = self.rewards.sum(axis=0)
        return total

    def weight_auc(self) -> float:
        """
        Compute the probability that a working modality has a larger weight than a failed one, each drawn from all steps
        of all episodes.
        """
        if self.weights is None:
            return float("nan")
        return auc(self.weights[self.alive].ravel(), self.reliable[self.alive].ravel())

    def weight_auc_in_step(self) -> float:
        """Compute the same probability for a working and a failed modality in the same step."""
        if self.weights is None:
            return float("nan")
        weights, reliable = self.weights[self.alive], self.reliable[self.alive]
        pairs = reliable[:, :, None] & ~reliable[:, None, :]
        difference = weights[:, :, None] - weights[:, None, :]
        return float(((difference > 0) + 0.5 * (difference == 0))[pairs].mean())


def make_model(method: str, seed: int, task: Mapping[str, Any] | None = None, **kwargs: Any) -> HAVESAC:
    """
    Create the model of a method.

    :param method: One of ``METHODS``, ``VARIANTS`` or ``DISTRIBUTIONAL``
    :param seed: Seed of networks, environments and exploration
    :param task: Options of the environment
    :param kwargs: Arguments of HAVESAC that replace those of the method
    :return: The model
    """
    distributional = method in DISTRIBUTIONAL
    settings = {**HYPERPARAMETERS, **{**METHODS, **VARIANTS, **DISTRIBUTIONAL}[method]}
    width = gve_width(distributional) if method.startswith("gve-wide") else WIDTH
    settings["policy_kwargs"] = {**policy_kwargs(width), **settings.get("policy_kwargs", {})}
    env = ReliabilityDriveVecEnv(N_ENVS, n_modalities=N_MODALITIES, **(task or {}))
    algorithm = DistributionalHAVESAC if distributional else HAVESAC
    return algorithm("MultiInputPolicy", env, seed=seed, device="cpu", **{**settings, **kwargs})


def policy_kwargs(width: int) -> dict[str, Any]:
    """Create the policy arguments for a width of the critics' hidden layers."""
    return {"features_dim": 32, "net_arch": {"pi": [WIDTH, WIDTH], "qf": [width, width]}}


def critic_size(width: int, value_estimation: str, distributional: bool = False) -> int:
    """Count the parameters of encoders and critics for a width of the critics' hidden layers."""
    method = "have-distributional" if distributional else "have"
    model = make_model(method, 0, value_estimation=value_estimation, policy_kwargs=policy_kwargs(width))
    return sum(parameter.numel() for parameter in model.critic.parameters())


@cache
def gve_width(distributional: bool = False) -> int:
    """Find the width at which a global critic alone has as many parameters as all critics of HAVE, within 1%."""
    wanted = critic_size(WIDTH, "have", distributional)
    low, high = WIDTH, 16 * WIDTH
    while low < high:
        middle = (low + high) // 2
        low, high = (middle + 1, high) if critic_size(middle, "gve", distributional) < wanted else (low, middle)
    assert abs(critic_size(low, "gve", distributional) / wanted - 1) < 0.01
    return low


def run(
    method: str,
    seed: int,
    n_updates: int,
    task: Mapping[str, Any] | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    evaluation_seed: int = EVALUATION_SEED,
) -> dict[str, float]:
    """
    Train a method and measure it.

    :param method: One of ``METHODS``, ``VARIANTS`` or ``DISTRIBUTIONAL``
    :param seed: Seed of the training; the evaluation episodes are the same for all
    :param n_updates: Number of updates of the critic
    :param task: Options of the environment, ``n_blind`` and ``corruption``
    :param hyperparameters: Changes of ``HYPERPARAMETERS``, e.g. ``{"learning_rate": 3e-4}``
    :param evaluation_seed: Seed of the episodes of the learning curve
    :return: Measures by name, NaN where a method has no such part:
        ``return_<n>``, the mean return after n updates, ``final_return``, the last one, and ``area``, their mean;
        ``weight_auc`` and ``weight_auc_in_step``, see :class:`Drive`;
        ``value_bias`` and ``value_correlation``, see :func:`value_errors`;
        ``negative_gradient`` on transitions from the replay buffer, see :func:`benchmarks.known_q.negative_gradient`;
        ``clean_return`` with all modalities working, and ``kept_black``, ``kept_frozen`` and ``kept_noise``, the share
        of it that remains when one modality fails for whole episodes, mean over the modalities;
        ``parameters``, the number of parameters of encoders and critics
    """
    th.set_num_threads(1)
    task = dict(task or {})
    model = make_model(method, seed, task, **(hyperparameters or {}))
    measures: dict[str, float] = {}
    for i in range(N_EVALUATIONS):
        due = n_updates * (i + 1) // N_EVALUATIONS
        steps = (due - model._n_updates) // UPDATES_PER_STEP + (WARM_UP if i == 0 else 0)
        model.learn(steps * N_ENVS, reset_num_timesteps=i == 0)
        drive = evaluate(model, seed=evaluation_seed, **task)
        measures[f"return_{due}"] = float(drive.returns.mean())
    measures["final_return"] = list(measures.values())[-1]
    measures["area"] = float(np.mean(list(measures.values())[:N_EVALUATIONS]))
    measures |= {"weight_auc": drive.weight_auc(), "weight_auc_in_step": drive.weight_auc_in_step()}
    bias, correlation = value_errors(model, **task)
    measures |= {"value_bias": bias, "value_correlation": correlation}
    assert model.replay_buffer is not None
    batch = model.replay_buffer.sample(N_GRADIENT_SAMPLES)
    measures["negative_gradient"] = negative_gradient(model, batch.observations, batch.actions)
    return {**measures, **kept_returns(model, **task), "parameters": sum(p.numel() for p in model.critic.parameters())}


def evaluate(model: HAVESAC, n_episodes: int = N_EPISODES, seed: int = EVALUATION_SEED, **options: Any) -> Drive:
    """
    Run whole episodes with deterministic actions.

    :param model: Model that was trained with ``N_MODALITIES`` modalities
    :param n_episodes: Number of episodes, which run in parallel
    :param seed: Seed of the first episode; the others have the following seeds
    :param options: Options of the environment, e.g. ``failure``
    :return: The episodes
    """
    env = ReliabilityDriveVecEnv(n_episodes, n_modalities=N_MODALITIES, **options)
    env.seed(seed)
    observation = env.reset()
    assert isinstance(observation, dict)
    alive = np.ones(n_episodes, bool)
    rows: list[tuple[Floats, NDArray[np.bool_], NDArray[np.bool_], Floats]] = []
    while alive.any():
        with th.no_grad():
            features = model.policy.encode({key: th.as_tensor(value) for key, value in observation.items()})
            actions = model.actor(features.flatten(start_dim=1), deterministic=True).numpy()
            weights = np.empty(0) if _is_gve(model) else model.critic.weights(features).numpy()
        reliable = env.batch.reliable.copy()
        observation, rewards, dones, _ = env.step(actions)
        assert isinstance(observation, dict)
        rows.append((rewards * alive, alive.copy(), reliable, weights))
        alive &= ~dones
    rewards, steps, reliable, weights = (np.stack(column) for column in zip(*rows, strict=True))
    return Drive(rewards, steps, reliable, None if _is_gve(model) else weights)


def kept_returns(model: HAVESAC, **options: Any) -> dict[str, float]:
    """Compute ``clean_return``, and the share of it that is kept under each kind of failure, see :func:`run`."""
    options = {**options, "corruption": 0.0}
    clean = float(evaluate(model, **options).returns.mean())
    measures = {"clean_return": clean}
    for kind in FAILURES:
        returns = [
            evaluate(model, failure=(modality, kind), **options).returns.mean() for modality in range(N_MODALITIES)
        ]
        measures[f"kept_{kind}"] = float(np.mean(returns)) / clean
    return measures


def value_errors(
    model: HAVESAC, n_episodes: int = N_EPISODES, n_steps: int = 200, **options: Any
) -> tuple[float, float]:
    """
    Compare the critic with Monte-Carlo returns of the stochastic policy, including its entropy:
    G_t = r_t + gamma (1 - end_t) (G_{t+1} - alpha log pi(a_{t+1})).

    The episodes have up to 2 ``n_steps`` steps, and the first ``n_steps`` count. G is the critic's own value where an
    episode is cut, which contributes with a factor of gamma^n_steps (0.02).

    :param model: The model
    :param n_episodes: Number of episodes
    :param n_steps: Number of steps that count
    :param options: Options of the environment
    :return: Bias, the mean of min_k Q_k - G divided by the standard deviation of G, and Pearson's correlation
    """
    env = ReliabilityDriveVecEnv(n_episodes, n_modalities=N_MODALITIES, max_episode_steps=2 * n_steps + 1, **options)
    env.seed(EVALUATION_SEED)
    observation = env.reset()
    alpha = float(model.ent_coef_tensor if model.log_ent_coef is None else model.log_ent_coef.detach().exp())
    alive = np.ones(n_episodes, bool)
    rows = []
    generator_state = th.get_rng_state()
    th.manual_seed(EVALUATION_SEED)
    for _ in range(2 * n_steps):
        assert isinstance(observation, dict)
        with th.no_grad():
            features = model.policy.encode({key: th.as_tensor(value) for key, value in observation.items()})
            actions, log_prob = model.actor.action_log_prob(features.flatten(start_dim=1))
            q = model.critic.values(features, actions).q.min(dim=0).values.numpy()
        observation, rewards, dones, _ = env.step(actions.numpy())
        rows.append((q, -alpha * log_prob.numpy(), rewards, alive.copy(), dones))
        alive &= ~dones
        if not alive.any():
            break
    th.set_rng_state(generator_state)
    q, bonus, rewards, lived, dones = (np.stack(column) for column in zip(*rows, strict=True))
    returns = np.empty_like(q)
    returns[-1] = np.where(dones[-1], rewards[-1], q[-1])
    for t in range(len(q) - 2, -1, -1):
        returns[t] = rewards[t] + model.gamma * ~dones[t] * (bonus[t + 1] + returns[t + 1])
    q, returns = q[:n_steps][lived[:n_steps]], returns[:n_steps][lived[:n_steps]]
    return float((q - returns).mean() / returns.std()), float(np.corrcoef(q, returns)[0, 1])


def _is_gve(model: HAVESAC) -> bool:
    return model.critic.value_estimation == "gve"
