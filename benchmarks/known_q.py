"""Measure how well the critic learns a Q-function that is known in closed form.

    OMP_NUM_THREADS=1 python -m benchmarks.known_q                       # every form, 8 seeds each
    OMP_NUM_THREADS=1 python -m benchmarks.known_q --forms have gve --seeds 3

HAVESAC learns the soft Q-function of the uniform policy from transitions of :class:`SensorRing`, with its own
``train()`` and an actor that stays uniform. The result is compared with the solution of a linear system. Each seed of
each form is a row of ``benchmarks/results/known_q/<form>.csv``; see :class:`Measures` for the columns.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeAlias

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor

from benchmarks.measure import RESULTS
from sb3_have import HAVESAC, MultiModalPolicy
from sb3_have.benchmark.provenance import machine

Floats: TypeAlias = NDArray[np.floating[Any]]
Observation: TypeAlias = dict[str, NDArray[np.float32]]

GAMMA = 0.9
ENT_COEF = 0.4
N_TRANSITIONS = 12_000
N_ENVS = 8
N_UPDATES = 1200
N_SAMPLES = 4000
FORMS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "have": {},
        "monotone": {"refusion": "monotone"},
        "free": {"refusion": "free"},
        "lve": {"value_estimation": "lve"},
        "gve": {"value_estimation": "gve"},
        "have-unsupervised": {"local_coef": 0.0},
        "have-paper": {"refusion": "free", "local_coef": 0.0, "target": "paper"},
    }
)


class SensorRing(gym.Env[Observation, NDArray[np.float32]]):
    """
    A walk on a ring of states, observed by two sensors that take turns to fail.

    The first action steers: the next state is the right neighbour with probability (1 + a_0) / 2, else the left one.
    The second action changes the reward, which is ``pay[s] + slope[s] * a_1``. Then the episode terminates with
    probability ``end[s]``; it is truncated after 20 steps. Each sensor shows the whole state, as a code of 8 numbers
    with a little noise. In most steps one of them fails, but never both: it is dark or noisy, which only shows in its
    own numbers. Failures are drawn in every step, so that the weights of one step are wrong in the next. ``info``
    contains ``state`` and ``reliable``, a flag for each sensor.
    """

    n_states: ClassVar[int] = 10
    keys: ClassVar[tuple[str, ...]] = ("left", "right")
    max_steps: ClassVar[int] = 20
    code_size: ClassVar[int] = 8

    def __init__(self) -> None:
        angle = 2 * np.pi * np.arange(self.n_states) / self.n_states
        self.pay = 1 + 2 * np.cos(angle)
        self.slope = np.sin(2 * angle)
        self.end = 0.15 * (1 + np.sin(angle))
        self.codes = np.random.default_rng(0).choice([-1.0, 1.0], (len(self.keys), self.n_states, self.code_size))
        box = spaces.Box(-np.inf, np.inf, (self.code_size,), np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Dict(dict.fromkeys(self.keys, box))
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = int(self.np_random.integers(self.n_states)) if options is None else int(options["state"])
        self.steps = 0
        return self._observe(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        reward = float(self.pay[self.state] + self.slope[self.state] * action[1])
        terminated = bool(self.np_random.random() < self.end[self.state])
        right = self.np_random.random() < (1 + action[0]) / 2
        self.state = (self.state + (1 if right else -1)) % self.n_states
        self.steps += 1
        truncated = self.steps == self.max_steps and not terminated
        return self._observe(), reward, terminated, truncated, self._info()

    def q_values(self, states: NDArray[np.integer[Any]], actions: Floats, gamma: float, ent_coef: float) -> Floats:
        """
        Compute the exact soft Q-values of the uniform policy.

        With V(s) = E_a[Q(s, a)] + ent_coef log |A|, Q(s, a) = r(s, a) + gamma (1 - end(s)) E_s'[V(s')] is linear in a,
        so its mean over a is its value at a = 0, and V solves a linear system.

        :param states: States, (B,)
        :param actions: Actions in [-1, 1], (B, 2)
        :param gamma: Discount factor
        :param ent_coef: Entropy coefficient, 0 for ordinary Q-values
        :return: Q-values, (B,)
        """
        right = np.roll(np.eye(self.n_states), 1, axis=1)
        alive = gamma * (1 - self.end)
        dynamics = np.eye(self.n_states) - alive[:, None] * (right + right.T) / 2
        values = np.linalg.solve(dynamics, self.pay + ent_coef * self.entropy)
        to_right = (1 + actions[:, 0]) / 2
        next_value = to_right * values[(states + 1) % self.n_states] + (1 - to_right) * values[states - 1]
        result: Floats = self.pay[states] + self.slope[states] * actions[:, 1] + alive[states] * next_value
        return result

    @property
    def entropy(self) -> float:
        """Entropy of the uniform policy on [-1, 1]^2, in nats."""
        return 2 * math.log(2)

    def _observe(self) -> Observation:
        """Draw which sensor fails and how, and return the codes of the state."""
        failed = self.np_random.choice([0, 1, -1], p=[0.4, 0.4, 0.2])  # -1: none
        noise = (0.1, 2.0)[int(self.np_random.integers(2))]
        self.reliable = np.arange(len(self.keys)) != failed
        values = np.where(self.reliable[:, None], self.codes[:, self.state], 0.0)
        values += np.where(self.reliable, 0.1, noise)[:, None] * self.np_random.normal(size=values.shape)
        return dict(zip(self.keys, values.astype(np.float32), strict=True))

    def _info(self) -> dict[str, Any]:
        return {"state": self.state, "reliable": self.reliable.copy()}


class UniformActor(Actor):
    """Actor that draws every action uniformly from [-1, 1]^A and does not learn."""

    def action_log_prob(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:  # type: ignore[override]
        n_actions = get_action_dim(self.action_space)
        return 2 * th.rand(len(obs), n_actions) - 1, th.full((len(obs),), -n_actions * math.log(2))


class UniformPolicy(MultiModalPolicy):
    """HAVE's critics with a uniform actor, so that they evaluate a policy instead of improving it."""

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        space = spaces.Box(-np.inf, np.inf, (len(self.critic.encoder.modalities) * self.critic.encoder.features_dim,))
        kwargs: dict[str, Any] = {**self.actor_kwargs, "observation_space": space}
        return UniformActor(features_extractor=FlattenExtractor(space), features_dim=space.shape[0], **kwargs)


class Samples(NamedTuple):
    """
    Fresh observations and actions with their exact Q-values.

    :param observations: Raw observations, (B, 8) per key
    :param actions: Uniform actions, (B, 2)
    :param q: Exact Q-values, (B,)
    :param reliable: Whether each sensor is reliable, (B, d)
    """

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    q: Floats
    reliable: NDArray[np.bool_]


@dataclass
class Measures:
    """
    Comparison of the critic with the exact Q-values; NaN where a form has no such part.

    :param error: Root mean square error of the Q-value (mean of the twins), in standard deviations of the exact Q
    :param bias: Mean error, in standard deviations of the exact Q
    :param std_ratio: Standard deviation of the Q-value divided by that of the exact Q
    :param correlation: Correlation with the exact Q
    :param local_error: ``error`` of each local critic where its sensor is reliable; the larger one
    :param negative_gradient: Share of samples where the re-fusion decreases in q_g or q_l
    :param weight_auc: Area under the ROC curve of a sensor's weight as a detector of the reliable sensor
    :param refusion_optimized: Share of the re-fusion's parameters that are in the critic's optimizer
    :param refusion_moved: Share of the re-fusion's parameter tensors that training changed
    :param seconds: Time for collecting and training
    """

    error: float
    bias: float
    std_ratio: float
    correlation: float
    local_error: float
    negative_gradient: float
    weight_auc: float
    refusion_optimized: float
    refusion_moved: float
    seconds: float


def make_model(seed: int, **kwargs: Any) -> HAVESAC:
    """Create an untrained model with the uniform actor and a replay buffer filled by the uniform policy."""
    settings: dict[str, Any] = {
        "learning_rate": 1e-3,
        "tau": 0.02,
        "gamma": GAMMA,
        "ent_coef": ENT_COEF,
        "buffer_size": N_TRANSITIONS,
        "learning_starts": N_TRANSITIONS,  # until then SB3 acts uniformly
        "policy_delay": 10**9,  # the actor has nothing to learn
        "auxiliary": None,
        "seed": seed,
        "device": "cpu",
        "policy_kwargs": {"net_arch": [64, 64], "features_dim": 32},
    }
    env = make_vec_env(SensorRing, N_ENVS, seed=seed)
    model = HAVESAC(UniformPolicy, env, **{**settings, **kwargs})
    return model.learn(model.learning_starts)


def sample(n_samples: int = N_SAMPLES, seed: int = 0) -> Samples:
    """Draw samples from episodes of the uniform policy that no model was trained on."""
    env = SensorRing()
    env.reset(seed=seed + 1_000_000)
    env.action_space.seed(seed + 1_000_000)
    rows, over = [], True
    for _ in range(n_samples):
        if over:
            observation, info = env.reset()
        rows.append((observation, env.action_space.sample(), info["state"], info["reliable"]))
        observation, _, terminated, truncated, info = env.step(rows[-1][1])
        over = terminated or truncated
    observations, actions, states, reliable = (list(column) for column in zip(*rows, strict=True))
    q = env.q_values(np.array(states), np.array(actions), GAMMA, ENT_COEF)
    stacked = {key: th.as_tensor(np.stack([row[key] for row in observations])) for key in env.keys}
    return Samples(stacked, th.as_tensor(np.array(actions)), q, np.array(reliable))


def evaluate(model: HAVESAC, samples: Samples) -> dict[str, float]:
    """Compute those of :class:`Measures` that only depend on the critic and the samples."""
    with th.no_grad():
        parts = model.critic.decompose(samples.observations, samples.actions)
    q, std = parts["q"].mean(dim=0).double().numpy(), samples.q.std()
    measures = {
        "error": root_mean_square(q - samples.q) / std,
        "bias": float(np.mean(q - samples.q)) / std,
        "std_ratio": q.std() / std,
        "correlation": float(np.corrcoef(q, samples.q)[0, 1]),
    }
    if "weights" in parts:
        q_local = parts["q_local"].mean(dim=0).double().numpy()  # (d, B)
        errors = [
            root_mean_square((local - samples.q)[reliable])
            for local, reliable in zip(q_local, samples.reliable.T, strict=True)
        ]
        one_failed = ~samples.reliable.all(axis=1)
        weights = parts["weights"].double().numpy()[one_failed]
        measures |= {
            "local_error": max(errors) / std,
            "weight_auc": auc(weights.ravel(), samples.reliable[one_failed].ravel()),
        }
    measures["negative_gradient"] = negative_gradient(model, samples.observations, samples.actions)
    return {name: float(value) for name, value in measures.items()}


def negative_gradient(model: HAVESAC, observations: PyTorchObs, actions: th.Tensor) -> float:
    """
    Compute the share of samples (and twins) where the Q-value decreases in the global or the weighted local value.

    :param model: The model
    :param observations: Batch of raw observations
    :param actions: Actions scaled to [-1, 1], (B, A)
    :return: The share; NaN for a model without re-fusion
    """
    if not hasattr(model.critic, "refusion"):
        return math.nan
    with th.no_grad():
        features = model.policy.encode(observations)
        values = model.critic.values(features, actions)
    assert values.q_global is not None and values.q_lve is not None
    inputs = [values.q_global.requires_grad_(), values.q_lve.requires_grad_()]
    mixed = model.critic.refusion(*inputs, features)
    gradients = th.stack(th.autograd.grad(mixed.sum(), inputs))
    return float((gradients < 0).any(dim=0).float().mean())


def run(seed: int, n_updates: int = N_UPDATES, n_samples: int = N_SAMPLES, **kwargs: Any) -> Measures:
    """
    Train a critic and compare it with the exact Q-values.

    :param seed: Seed of networks, transitions, minibatches and samples
    :param n_updates: Number of updates of the critic
    :param n_samples: Number of samples for the comparison
    :param kwargs: Arguments of HAVESAC, see ``FORMS``
    :return: The comparison
    """
    start = time.perf_counter()
    model = make_model(seed, **kwargs)
    refusion = list(model.critic.refusion.parameters()) if model.critic.value_estimation == "have" else []
    before = [parameter.detach().clone() for parameter in refusion]
    model.train(n_updates, batch_size=128)
    seconds = time.perf_counter() - start
    optimized = {id(parameter) for group in model.critic.optimizer.param_groups for parameter in group["params"]}
    moved = [not th.equal(old, new) for old, new in zip(before, refusion, strict=True)]
    measures = dict.fromkeys(Measures.__annotations__, math.nan)
    measures |= evaluate(model, sample(n_samples, seed))
    if refusion:
        measures["refusion_optimized"] = float(np.mean([id(parameter) in optimized for parameter in refusion]))
        measures["refusion_moved"] = float(np.mean(moved))
    return Measures(**{**measures, "seconds": seconds})


def root_mean_square(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def auc(scores: Floats, labels: NDArray[np.bool_]) -> float:
    """Compute the probability that a true sample has the higher score (ties count half), the Mann-Whitney statistic."""
    ranks = pd.Series(scores).rank().to_numpy()
    n_true = int(labels.sum())
    return float((ranks[labels].sum() - n_true * (n_true + 1) / 2) / (n_true * (len(labels) - n_true)))


def table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Compute the range of each measure over the seeds, one row per form."""
    measured = pd.DataFrame(rows)[["form", *Measures.__annotations__]]

    def span(column: pd.Series[float]) -> str:
        return "-" if column.isna().all() else f"{column.min():.3g} .. {column.max():.3g}"

    return measured.groupby("form", sort=False).agg(span)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--forms", nargs="+", choices=list(FORMS), default=list(FORMS))
    parser.add_argument("--seeds", type=int, default=8, help="number of seeds, starting from 0")
    parser.add_argument("--updates", type=int, default=N_UPDATES)
    args = parser.parse_args()
    folder = RESULTS / "known_q"
    folder.mkdir(parents=True, exist_ok=True)
    everything = []
    for form in args.forms:
        rows = []
        for seed in range(args.seeds):
            measures = run(seed, args.updates, **FORMS[form])
            rows.append({"form": form, "seed": seed, "updates": args.updates, **vars(measures), **machine()})
            pd.DataFrame(rows).round(5).to_csv(folder / f"{form}.csv", index=False)
        print(table(rows).T.to_string(), flush=True)
        everything += rows
    print(table(everything).T.to_string())


if __name__ == "__main__":
    main()
