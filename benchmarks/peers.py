"""Measure an update of HAVESAC and of peers outside of SB3: a bare loop with one camera, and sbx on vectors.

    OMP_NUM_THREADS=1 taskset -c 0 python -m benchmarks.peers       # --tasks camera vector

All contenders have the same layers, batches and data, take turns in one process, and update critics, actor, temperature
and target every time. The task ``camera`` has RGB images of 64x64 px, three stacked frames, the Nature encoder and
batches of 64:

- ``bare loop``: a loop without a framework in the style of DrQ-v2 and CleanRL. The critic trains the encoder, the actor
  uses detached features, next observations go through the same encoder, and both observations of a transition are
  stored whole in arrays of bytes;
- ``HAVESAC``: the defaults; ``HAVESAC gve``: the global critic alone, without auxiliary losses, which is the same
  algorithm as the bare loop except for the target encoder;
- ``SB3 SAC`` and ``SB3 SAC shared``: see ``benchmarks.update_speed``.

The task ``vector`` is ``ReliabilityDrive-v0``, with three sensors of 32 numbers, two layers of 256 and batches of 256.
``SB3 SAC`` and ``sbx SAC`` (``pip install "sb3_have[peers]"``, skipped if it is not installed) use flattened
observations. HAVESAC also has an encoder per sensor (a linear layer of 50 and LayerNorm).

The columns are ``what``, which is ``update`` (one gradient step, including sampling), ``act and store`` (an action for
one observation, and one transition into the replay memory) or ``learn`` (a step of ``learn()`` with one update,
including the environment); median and quartiles of the wall-clock time; ``cpu_ms``, the median processor time; and
``vs_havesac``, the time divided by that of HAVESAC in float32, median over the rounds. ``--threads`` does not limit
JAX, but ``taskset`` does.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import polyak_update
from torch import nn
from torch.nn import functional as F

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from benchmarks.random_sensors import make_env, transitions
from benchmarks.update_speed import BUFFER_SIZE, FEATURES_DIM, NET_ARCH, have_sac, plain_encoder, ready, sb3_sac
from sb3_have import HAVESAC
from sb3_have.common.encoders import has_native_bfloat16

Contender = tuple[str, str, str]  # name, precision, what
VECTOR_ENV = "ReliabilityDrive-v0"
LEARN_STEPS = 20
GROUP = ("task", "device", "threads")


def mlp(n_inputs: int, n_outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in NET_ARCH:
        layers += [nn.Linear(n_inputs, width), nn.ReLU()]
        n_inputs = width
    return nn.Sequential(*layers, nn.Linear(n_inputs, n_outputs))


class Twins(nn.Module):
    """Two critics on features and actions."""

    def __init__(self, n_actions: int):
        super().__init__()
        self.critics = nn.ModuleList(mlp(FEATURES_DIM + n_actions, 1) for _ in range(2))

    def forward(self, features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        inputs = th.cat([features, actions], dim=1)
        return th.stack([critic(inputs) for critic in self.critics])


class BareLoop:
    """
    SAC from pixels without a framework.

    :param space: Space of the stacked images, channels first
    :param n_actions: Number of actions, each in -1..1
    :param batch_size: Batch size of an update
    :param device: "cpu" or "cuda"
    :param precision: Precision of the encoder, "float32" or "bfloat16"
    """

    gamma, tau = 0.99, 0.005

    def __init__(self, space: spaces.Box, n_actions: int, batch_size: int, device: str, precision: str = "float32"):
        self.batch_size, self.device, self.precision, self.n_actions = batch_size, device, precision, n_actions
        self.encoder = plain_encoder(space).to(device)
        self.critic, self.target = Twins(n_actions).to(device), Twins(n_actions).to(device)
        self.target.load_state_dict(self.critic.state_dict())
        self.actor = mlp(FEATURES_DIM, 2 * n_actions).to(device)
        self.log_alpha = th.zeros(1, device=device, requires_grad=True)
        self.critic_optimizer = th.optim.Adam([*self.encoder.parameters(), *self.critic.parameters()], 3e-4)
        self.actor_optimizer = th.optim.Adam(self.actor.parameters(), 3e-4)
        self.alpha_optimizer = th.optim.Adam([self.log_alpha], 3e-4)
        self.obs, self.next_obs = (np.zeros((BUFFER_SIZE, *space.shape), np.uint8) for _ in range(2))
        self.actions = np.zeros((BUFFER_SIZE, n_actions), np.float32)
        self.rewards, self.dones = (np.zeros((BUFFER_SIZE, 1), np.float32) for _ in range(2))
        self.stored = 0
        self.rng = np.random.default_rng(0)

    def encode(self, images: np.ndarray) -> th.Tensor:
        inputs = th.as_tensor(images, device=self.device)
        with th.autocast(inputs.device.type, dtype=th.bfloat16, enabled=self.precision == "bfloat16"):
            features: th.Tensor = self.encoder(inputs.float() / 255.0)
        return features.float()

    def sample(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Draw actions, and compute their log probabilities (B, 1)."""
        mean, log_std = self.actor(features).chunk(2, dim=1)
        normal = th.distributions.Normal(mean, log_std.clamp(-20, 2).exp(), validate_args=False)
        before = normal.rsample()
        actions = before.tanh()
        log_prob = normal.log_prob(before) - th.log(1 - actions**2 + 1e-6)  # type: ignore[no-untyped-call]
        return actions, log_prob.sum(dim=1, keepdim=True)

    @th.no_grad()
    def act(self, images: np.ndarray) -> np.ndarray:
        actions: np.ndarray = self.sample(self.encode(images))[0].cpu().numpy()
        return actions

    def store(self, obs: Any, next_obs: Any, actions: Any, rewards: Any, dones: Any) -> None:
        row = self.stored % BUFFER_SIZE
        self.obs[row], self.next_obs[row] = obs[0], next_obs[0]
        self.actions[row], self.rewards[row], self.dones[row] = actions[0], rewards[0], dones[0]
        self.stored += 1

    def update(self) -> None:
        rows = self.rng.integers(min(self.stored, BUFFER_SIZE), size=self.batch_size)
        actions, rewards, dones = (
            th.as_tensor(part[rows], device=self.device) for part in (self.actions, self.rewards, self.dones)
        )
        alpha = self.log_alpha.exp().detach()
        with th.no_grad():
            next_features = self.encode(self.next_obs[rows])
            next_actions, next_log_prob = self.sample(next_features)
            next_q = self.target(next_features, next_actions).amin(dim=0) - alpha * next_log_prob
            target = rewards + self.gamma * (1 - dones) * next_q
        features = self.encode(self.obs[rows])
        q = self.critic(features, actions)
        minimize(0.5 * F.mse_loss(q, target.expand_as(q), reduction="none").mean(dim=1).sum(), self.critic_optimizer)

        features = features.detach()
        new_actions, log_prob = self.sample(features)
        new_q = self.critic(features, new_actions).amin(dim=0)
        minimize((alpha * log_prob - new_q).mean(), self.actor_optimizer)
        minimize(-(self.log_alpha * (log_prob.detach() - self.n_actions)).mean(), self.alpha_optimizer)
        polyak_update(self.critic.parameters(), self.target.parameters(), self.tau)


def minimize(loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


def camera(device: str, image_size: int = 64, batch_size: int = 64) -> dict[Contender, Callable[[], object]]:
    """Create the calls to time with one camera and full replay memories."""
    env = make_env({"rgb": 3}, image_size)
    space, lived = env.observation_space["rgb"], list(transitions(env, BUFFER_SIZE))  # type: ignore[index]
    calls: dict[Contender, Callable[[], object]] = {}

    def add_model(name: str, precision: str, model: SAC) -> None:
        buffer, turn = model.replay_buffer, itertools.cycle(lived)
        assert buffer is not None

        def act_and_store() -> None:
            transition = next(turn)
            model.predict(transition[0], deterministic=False)
            buffer.add(*transition)

        ready([model], env)
        calls[name, precision, "update"] = lambda: model.train(gradient_steps=1, batch_size=batch_size)
        calls[name, precision, "act and store"] = act_and_store

    def add_bare(precision: str) -> None:
        loop, turn = BareLoop(space, env.action_space.shape[0], batch_size, device, precision), itertools.cycle(lived)  # type: ignore[index]

        def act_and_store() -> None:
            obs, next_obs, actions, rewards, dones, _ = next(turn)
            loop.act(obs["rgb"])
            loop.store(obs["rgb"], next_obs["rgb"], actions, rewards, dones)

        for obs, next_obs, actions, rewards, dones, _ in lived:
            loop.store(obs["rgb"], next_obs["rgb"], actions, rewards, dones)
        calls["bare loop", precision, "update"] = loop.update
        calls["bare loop", precision, "act and store"] = act_and_store

    add_model("SB3 SAC", "float32", sb3_sac(env, False, device))
    add_model("SB3 SAC shared", "float32", sb3_sac(env, True, device))
    for precision in ("float32", "bfloat16") if has_native_bfloat16(device) else ("float32",):
        add_bare(precision)
        add_model("HAVESAC", precision, have_sac(env, precision, device))
        plain = have_sac(env, precision, device, value_estimation="gve", auxiliary=None)
        add_model("HAVESAC gve", precision, plain)
    return calls


def vector(batch_size: int = 256) -> dict[Contender, Callable[[], object]]:
    """Create the calls to time on vectors. The models have learned for some steps, so that JAX has compiled."""
    options: dict[str, Any] = {"buffer_size": 10_000, "learning_starts": 2 * LEARN_STEPS, "batch_size": batch_size}
    options |= {
        "train_freq": 1,
        "gradient_steps": 1,
        "seed": 0,
        "device": "cpu",
        "policy_kwargs": {"net_arch": NET_ARCH},
    }
    models: dict[str, OffPolicyAlgorithm] = {
        "SB3 SAC": SAC("MlpPolicy", FlattenObservation(gym.make(VECTOR_ENV)), **options),
        "HAVESAC": HAVESAC("MultiInputPolicy", gym.make(VECTOR_ENV), **options),
        "HAVESAC gve": HAVESAC(
            "MultiInputPolicy", gym.make(VECTOR_ENV), value_estimation="gve", auxiliary=None, **options
        ),
    }
    if find_spec("sbx") is None:
        print('sbx is not installed, skipping it: pip install "sb3_have[peers]"')
    else:
        sbx: Any = import_module("sbx")
        models["sbx SAC"] = sbx.SAC("MlpPolicy", FlattenObservation(gym.make(VECTOR_ENV)), **options)
    calls: dict[Contender, Callable[[], object]] = {}
    for name, model in models.items():
        model.set_logger(configure(None, []))
        model.learn(3 * LEARN_STEPS)
        calls[name, "float32", "update"] = lambda model=model: model.train(1, batch_size)  # type: ignore[misc]
        calls[name, "float32", "learn"] = lambda model=model: model.learn(  # type: ignore[misc]
            LEARN_STEPS, reset_num_timesteps=False
        )
    return calls


def measure(calls: Mapping[Contender, Callable[[], object]], rounds: int) -> list[Row]:
    """
    Measure the calls.

    :param calls: Calls by contender, precision and kind
    :param rounds: Number of rounds that count
    :return: One row per call
    """
    measured = interleave(calls, rounds, warm_up=max(1, rounds // 10))
    rows = []
    for (name, precision, what), (wall, cpu) in measured.items():
        each = LEARN_STEPS if what == "learn" else 1
        row: Row = {"contender": name, "precision": precision, "what": what, **quartiles(wall / each)}
        row["cpu_ms"] = round(float(np.median(cpu)) / each, 3)
        row["vs_havesac"] = round(median_ratio(wall, measured["HAVESAC", "float32", what].wall), 2)
        rows.append(row)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=("camera", "vector"), default=["camera", "vector"])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--device", default="cpu", help="device for the task camera")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--output", type=Path, default=RESULTS / "peers.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    rows: list[Row] = []
    for task in args.tasks:
        device = args.device if task == "camera" else "cpu"
        measured = measure(camera(device) if task == "camera" else vector(), args.rounds)
        about = machine(device)
        if any(row["contender"] == "sbx SAC" for row in measured):
            about["versions"] += f", sbx {version('sbx-rl')}, jax {version('jax')}"
        print(f"\n{task}, {args.rounds} rounds", *about.values(), sep="\n")
        show(measured, [*measured[0]])
        settings = {"task": task, "device": device, "threads": args.threads, "rounds": args.rounds}
        rows += [{**settings, **row, **about} for row in measured]
        save(rows, args.output, GROUP)


if __name__ == "__main__":
    main()
