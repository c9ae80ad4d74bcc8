"""The task with known Q: its closed form, its sensors, what is measured of a critic, and a short training."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th

from benchmarks import known_q
from benchmarks.known_q import ENT_COEF, GAMMA, Samples, SensorRing, auc, evaluate, make_model, run, sample
from sb3_have import HAVESAC


@pytest.fixture(scope="module")
def samples() -> Samples:
    return sample(1000)


def untrained(**kwargs: Any) -> HAVESAC:
    return make_model(0, **{"learning_starts": 16, "buffer_size": 16, **kwargs})


def within_standard_errors(values: np.ndarray, number: float = 4) -> np.ndarray:
    """Whether the means over the first axis may be 0."""
    result: np.ndarray = np.abs(values.mean(axis=0)) < number * values.std(axis=0) / math.sqrt(len(values))
    return result


def test_closed_form_is_the_mean_return() -> None:
    """
    Soft and ordinary Q against returns of simulated episodes from each state. The time limit is stepped over: it cuts
    an episode and not its value.
    """
    env = SensorRing()
    env.reset(seed=0)
    env.action_space.seed(0)
    states = np.tile(np.arange(env.n_states), 200)
    actions = np.stack([env.action_space.sample() for _ in states])
    returns, bonus = np.zeros(len(states)), np.zeros(len(states))
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        env.reset(options={"state": state})
        discount = 1.0
        while discount > 1e-2:
            _, reward, terminated, _, _ = env.step(action)
            returns[i] += discount * reward
            discount *= GAMMA
            if terminated:
                break
            bonus[i] += discount * math.log(4)  # -log pi of the next action
            action = env.action_space.sample()
    for ent_coef in (0.0, ENT_COEF):
        difference = returns + ent_coef * bonus - env.q_values(states, actions, GAMMA, ent_coef)
        assert within_standard_errors(difference)
        assert within_standard_errors(difference.reshape(-1, env.n_states)).all()


def test_closed_form_solves_bellmans_equation() -> None:
    """Q(s, a) = E[r + gamma (1 - end) (Q(s', a') - ent_coef log pi)] over single steps, by state and action."""
    env = SensorRing()
    env.reset(seed=0)
    env.action_space.seed(0)
    rows = []
    for _ in range(8000):
        env.reset()
        state, action = env.state, env.action_space.sample()
        _, reward, terminated, _, _ = env.step(action)
        rows.append((state, *action, reward, terminated, env.state, *env.action_space.sample()))
    state, steer, earn, reward, terminated, next_state, *next_action = np.array(rows).T
    next_q = env.q_values(next_state.astype(int), np.stack(next_action, axis=1), GAMMA, ENT_COEF)
    target = reward + GAMMA * (1 - terminated) * (next_q + ENT_COEF * math.log(4))
    difference = target - env.q_values(state.astype(int), np.stack([steer, earn], axis=1), GAMMA, ENT_COEF)
    angle = 2 * np.pi * state / env.n_states
    of_state = np.stack([np.ones_like(angle), *(f(k * angle) for f in (np.cos, np.sin) for k in (1, 2))], axis=1)
    for of_action in (1.0, steer[:, None], earn[:, None]):
        assert within_standard_errors(difference[:, None] * of_state * of_action).all()


def test_q_of_a_task_without_dynamics() -> None:
    """Constant pay, no ends: (1 + gamma * bonus) / (1 - gamma), by hand."""
    env = SensorRing()
    env.pay, env.slope, env.end = np.ones(10), np.zeros(10), np.zeros(10)
    q = env.q_values(np.arange(10), np.zeros((10, 2)), 0.9, 0.5)
    np.testing.assert_allclose(q, 10 + 0.9 * 0.5 * 2 * math.log(2) / (1 - 0.9))


def test_sensors_fail_in_turn() -> None:
    env = SensorRing()
    assert all(len(np.unique(codes, axis=0)) == env.n_states for codes in env.codes)
    observation, info = env.reset(seed=0)
    env.action_space.seed(0)
    seen = []
    for _ in range(6000):
        shown = np.stack([observation[key] for key in env.keys])
        errors = np.abs(shown - env.codes[:, info["state"]]).max(axis=1)
        assert ((errors < 0.6) == info["reliable"]).all()
        seen.append(tuple(info["reliable"]))
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            assert not (terminated and truncated)
            observation, info = env.reset()
    assert set(seen) == {(True, True), (True, False), (False, True)}


class EndlessRing(SensorRing):
    def __init__(self) -> None:
        super().__init__()
        self.end = np.zeros(self.n_states)


@pytest.mark.parametrize("env_class,ends", [(SensorRing, (0.1, 0.2)), (EndlessRing, (-0.01, 0.01))])
def test_transitions_of_the_uniform_policy(
    env_class: type[SensorRing], ends: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Actions over the whole range; ends are stored as such, and time limits as none."""
    monkeypatch.setattr(known_q, "SensorRing", env_class)
    model = untrained(learning_starts=2000, buffer_size=2000)
    assert model.replay_buffer is not None and model._n_updates == 0
    batch = model.replay_buffer.sample(2000)
    assert float(batch.actions.var(dim=0).sub(1 / 3).abs().max()) < 0.05
    assert ends[0] < float(batch.dones.mean()) < ends[1]


def test_uniform_actor() -> None:
    model = untrained()
    th.manual_seed(0)
    actions, log_prob = model.actor.action_log_prob(th.zeros(5000, 64))
    assert float(actions.abs().max()) <= 1 and float(actions.var(dim=0).sub(1 / 3).abs().max()) < 0.02
    assert th.allclose(log_prob, th.tensor(-math.log(4)))  # the density is 1/4 on [-1, 1]^2
    before = th.nn.utils.parameters_to_vector(model.actor.parameters()).clone()
    model.train(2, batch_size=8)
    assert th.equal(before, th.nn.utils.parameters_to_vector(model.actor.parameters()))


def test_measures_of_a_critic_that_is_off_by_a_known_amount(samples: Samples, monkeypatch: pytest.MonkeyPatch) -> None:
    model = untrained()
    q, std = th.as_tensor(samples.q), samples.q.std()
    reliable = th.as_tensor(samples.reliable)
    local = th.where(reliable.t(), q + 3, q - 100)  # where a sensor fails, its critic may say anything
    said = {
        "q": th.stack([1.5 * q, 0.9 * q + 1]),  # 1.2 q + 0.5 in the mean
        "q_global": th.stack([q, q]).float(),
        "q_lve": th.stack([q, q]).float(),
        "q_local": th.stack([local, local]),
        "weights": 0.2 + 0.6 * reliable.double(),
    }
    monkeypatch.setattr(model.critic, "decompose", lambda observations, actions: said)
    measures = evaluate(model, samples)
    assert measures["std_ratio"] == pytest.approx(1.2)
    assert measures["correlation"] == pytest.approx(1)
    assert measures["bias"] == pytest.approx((0.2 * samples.q.mean() + 0.5) / std)
    assert measures["error"] == pytest.approx(np.sqrt(np.mean((0.2 * samples.q + 0.5) ** 2)) / std)
    assert measures["local_error"] == pytest.approx(3 / std)
    assert measures["weight_auc"] == 1
    assert measures["negative_gradient"] == 0


@pytest.mark.parametrize("refusion,share", [("convex", 0), ("monotone", 0), ("free", 1)])
def test_negative_gradients_are_counted(samples: Samples, refusion: str, share: float) -> None:
    model = untrained(refusion=refusion)
    if refusion == "free":  # H = -8 leaky_relu(q_g + q_l)
        with th.no_grad():
            for name, parameter in model.critic.refusion.named_parameters():
                parameter.fill_({"hyper_w1.bias": 1.0, "hyper_w2.bias": -1.0}.get(name, 0.0))
    assert evaluate(model, samples)["negative_gradient"] == share


def test_auc_against_all_pairs() -> None:
    rng = np.random.default_rng(0)
    scores, labels = rng.integers(0, 5, 60).astype(float), rng.random(60) < 0.4
    pairs = scores[labels][:, None] - scores[~labels]
    assert auc(scores, labels) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean())


@pytest.mark.parametrize("form", known_q.FORMS)
def test_every_form_is_built_as_it_is_called(form: str) -> None:
    model = untrained(**known_q.FORMS[form])
    value_estimation = form if form in ("lve", "gve") else "have"
    assert model.critic.value_estimation == value_estimation
    if value_estimation == "have":
        expected = {"monotone": "monotone", "free": "free", "have-paper": "free"}.get(form, "convex")
        assert model.critic.refusion.refusion == expected
    assert model.local_coef == (0 if form in ("have-unsupervised", "have-paper") else 1)
    assert model.target == ("paper" if form == "have-paper" else "bellman")


def test_a_short_training_comes_near() -> None:
    """A fifth of the suite's updates, in bounds wide enough for that; the sound formulas reach half of them."""
    measures = run(seed=0, n_updates=300, n_samples=1000, learning_starts=4000)
    assert measures.error < 1 and abs(measures.bias) < 0.9 and 0.6 < measures.std_ratio < 1.1
    assert measures.correlation > 0.9 and measures.local_error < 1
    assert measures.negative_gradient == 0 and measures.weight_auc > 0.97
    assert measures.refusion_optimized == measures.refusion_moved == 1
