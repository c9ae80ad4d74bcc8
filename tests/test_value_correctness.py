"""The critic's value on a Markov chain whose values are known in closed form."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from envs import FixedBatch, batched, fill_buffer, quiet_logger, tiny_model, vector, vectors_space
from gymnasium import spaces

from sb3_have import HAVESAC

GAMMA = 0.9


class Transition(NamedTuple):
    """What happens in a state, whatever the action."""

    reward: float
    next_state: int
    terminated: bool = False
    timeout: bool = False


CHAIN = [
    Transition(1.0, 0),  # a constant reward for ever
    Transition(2.0, 2),  # two states in turn
    Transition(-1.0, 1),
    Transition(1.0, 4),  # two states, then the end
    Transition(2.0, 4, terminated=True),
    Transition(0.5, 5, timeout=True),  # cut by a time limit, which is no end
    Transition(3.0, 6, terminated=True),
]
VALUES = [
    1 / (1 - GAMMA),
    (2 - GAMMA) / (1 - GAMMA**2),
    (-1 + 2 * GAMMA) / (1 - GAMMA**2),
    1 + 2 * GAMMA,
    2.0,
    0.5 / (1 - GAMMA),
    3.0,
]


def observe(state: int) -> dict[str, np.ndarray]:
    """A modality that tells the state, and one that tells nothing."""
    return {"seeing": np.eye(len(CHAIN), dtype=np.float32)[state], "blind": np.full(6, 0.5, np.float32)}


def chain_model(**kwargs: Any) -> HAVESAC:
    """A model whose replay buffer holds every state of the chain with many actions."""
    space = spaces.Dict({"seeing": vector(len(CHAIN)), "blind": vector(6)})
    n_actions = 60
    settings = {"gamma": GAMMA, "ent_coef": 0.0, "learning_rate": 3e-3, "tau": 0.2, "auxiliary": None}
    model = tiny_model(space, buffer_size=n_actions * len(CHAIN), **{**settings, **kwargs})
    model.set_logger(quiet_logger())
    rng = np.random.default_rng(1)
    assert model.replay_buffer is not None
    for state, transition in enumerate(CHAIN):
        for _ in range(n_actions):
            model.replay_buffer.add(
                batched(observe(state)),
                batched(observe(transition.next_state)),
                rng.uniform(-1, 1, (1, 2)).astype(np.float32),
                np.array([transition.reward]),
                np.array([transition.terminated or transition.timeout]),
                [{"TimeLimit.truncated": transition.timeout}],
            )
    return model


@pytest.mark.parametrize("value_estimation", ["have", "lve", "gve"])
def test_values_of_a_known_chain(value_estimation: str) -> None:
    """
    Q within 2% in every state: the discount, the end of an episode (no bootstrap), a time limit (bootstrap) and, as one
    modality is blind, the weights of the right network and step.
    """
    model = chain_model(value_estimation=value_estimation)
    model.train(700, batch_size=64)
    model.lr_schedule = lambda progress: 3e-4  # the last steps are small, against the noise of the batches
    model.train(100, batch_size=64)

    n_states, n_actions = len(CHAIN), 20
    rows = [observe(state) for state in range(n_states)] * n_actions
    obs = {key: th.as_tensor(np.stack([row[key] for row in rows])) for key in rows[0]}
    actions = 2 * th.rand(len(rows), 2, generator=th.Generator().manual_seed(0)) - 1
    with th.no_grad():
        parts = model.critic.decompose(obs, actions)
    if value_estimation != "gve":
        seeing = list(model.critic.encoder.modalities).index("seeing")
        assert float(parts.pop("weights")[:, seeing].min()) > 0.9
        parts["q_seeing"] = parts.pop("q_local")[:, seeing]
    for name, part in parts.items():
        mean = part.reshape(-1, n_actions, n_states).mean(dim=1)  # over the actions, which change nothing
        np.testing.assert_allclose(mean, np.broadcast_to(VALUES, mean.shape), rtol=0.02, err_msg=name)


def mixed_model(refusion: str, target: str) -> HAVESAC:
    """A model with random, unequal target networks and one batch with terminations."""
    space = vectors_space(3)
    model = tiny_model(
        space, refusion=refusion, target=target, gamma=GAMMA, ent_coef=0.2, replay_buffer_class=FixedBatch
    )
    th.manual_seed(3)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * th.randn_like(parameter))
    fill_buffer(model, 100)
    assert isinstance(model.replay_buffer, FixedBatch)
    model.replay_buffer.batch = super(FixedBatch, model.replay_buffer).sample(64)
    assert 0 < model.replay_buffer.batch.dones.sum() < 64
    return model


@pytest.mark.parametrize("refusion,equal", [("convex", True), ("monotone", False), ("free", False)])
def test_mixing_both_sides_is_the_bellman_target_if_convex(refusion: str, equal: bool) -> None:
    """Eq. 10 as it is written, and y = r + gamma (1 - done)(min_k H'_k - alpha log pi): the same loss, to rounding."""
    losses = []
    for target in ("bellman", "paper"):
        model = mixed_model(refusion, target)
        th.manual_seed(4)
        model.train(1, batch_size=64)
        losses.append(model.logger.name_to_value["train/critic_loss"])
    assert (losses[0] == pytest.approx(losses[1], rel=1e-5)) == equal


def test_both_targets_train_convex_mixing_alike() -> None:
    trained = []
    for target in ("bellman", "paper"):
        model = mixed_model("convex", target)
        th.manual_seed(4)
        model.train(5, batch_size=64)
        trained.append(th.nn.utils.parameters_to_vector(model.critic.parameters()).detach())
    assert th.allclose(trained[0], trained[1], atol=1e-4)


@pytest.mark.parametrize("gamma", [0, 1, 0.5])
def test_discount_of_any_number_type(gamma: float) -> None:
    """A discount of 0 or 1, written as an integer, is a number like another."""
    model = chain_model(gamma=gamma)
    model.train(2, batch_size=16)
    assert np.isfinite(model.logger.name_to_value["train/critic_loss"])


def test_several_steps_bootstrap_with_their_own_discount() -> None:
    """SB3's n-step buffer (plain Box only) gives each sample its discount: a constant reward is still worth 10."""
    model = tiny_model(
        vector(3), gamma=GAMMA, ent_coef=0.0, learning_rate=3e-3, tau=0.2, n_steps=3, auxiliary=None, buffer_size=100
    )
    model.set_logger(quiet_logger())
    rng = np.random.default_rng(0)
    assert model.replay_buffer is not None
    observation = np.full((1, 3), 0.5, np.float32)
    for _ in range(100):
        action = rng.uniform(-1, 1, (1, 2)).astype(np.float32)
        model.replay_buffer.add(observation, observation, action, np.ones(1), np.zeros(1, bool), [{}])
    model.train(300, batch_size=32)
    with th.no_grad():
        q, _ = model.critic(th.as_tensor(observation), th.zeros(1, 2))
    assert float(q) == pytest.approx(1 / (1 - GAMMA), rel=0.02)
