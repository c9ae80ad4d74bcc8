"""The reliability benchmark: its measures on known answers, and runs that are made once, whatever stops it."""

import itertools
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th

from benchmarks import reliability, reliability_runs
from benchmarks.reliability_report import report, values
from benchmarks.reliability_runs import METHODS, Drive, evaluate, make_model
from benchmarks.reliability_vec_env import ReliabilityDriveVecEnv
from sb3_have import HAVESAC


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of a second, their episodes cut early."""
    monkeypatch.setattr(
        reliability_runs, "ReliabilityDriveVecEnv", partial(ReliabilityDriveVecEnv, max_episode_steps=20)
    )
    for name, value in {"N_EVALUATIONS": 2, "N_EPISODES": 2, "WARM_UP": 20}.items():
        monkeypatch.setattr(reliability_runs, name, value)


@pytest.mark.parametrize(
    "method,have,ratio",
    [
        ("gve-wide", "have", 1.0),
        ("gve-wide-dropout", "have", 1.0),
        ("gve", "have", 0.44),
        ("gve-wide-distributional", "have-distributional", 1.0),
    ],
)
def test_wide_critic_is_as_large_as_have(method: str, have: str, ratio: float) -> None:
    sizes = [sum(p.numel() for p in make_model(name, 0).critic.parameters()) for name in (method, have)]
    assert sizes[0] / sizes[1] == pytest.approx(ratio, abs=0.01)


@pytest.mark.parametrize("method", METHODS)
def test_methods_differ_in_what_they_are_named_for_alone(method: str) -> None:
    model, have = make_model(method, 0), make_model("have", 0)
    settings = ("value_estimation", "modality_dropout", "local_coef", "refusion")
    different = {name for name in settings if _setting(model, name) != _setting(have, name)}
    assert different == METHODS[method].keys()
    for name in ("learning_rate", "gamma", "tau", "batch_size", "policy_delay", "gradient_steps", "auxiliary_coefs"):
        assert getattr(model, name) == getattr(have, name)
    sizes = [sum(p.numel() for p in m.actor.parameters()) for m in (model, have)]
    assert sizes[0] == sizes[1]


def _setting(model: HAVESAC, name: str) -> Any:
    if name == "refusion":  # which "gve" and "lve" do not have
        return model.critic.refusion.refusion if model.critic.value_estimation == "have" else "convex"
    return model.critic.value_estimation if name == "value_estimation" else getattr(model, name)


def drive(weights: np.ndarray, reliable: np.ndarray, alive: np.ndarray | None = None) -> Drive:
    """A drive of one episode with weights (S, d) and truth (S, d)."""
    alive = np.ones(len(weights), bool) if alive is None else alive
    return Drive(np.ones((len(weights), 1)), alive[:, None], reliable[:, None], weights[:, None])


def test_weight_auc() -> None:
    """Of all pairs of a sound and a failed modality, from anywhere or in one step; what comes after the end is out."""
    reliable = np.array([[True, False], [False, True], [True, True], [False, True]])
    weights = np.array([[0.8, 0.2], [0.4, 0.6], [0.3, 0.7], [0.9, 0.1]])
    alive = np.array([True, True, True, False])
    measured = drive(weights, reliable, alive)
    sound, failed = [0.8, 0.6, 0.3, 0.7], [0.2, 0.4]
    wins = [a > b for a, b in itertools.product(sound, failed)]
    assert measured.weight_auc() == pytest.approx(np.mean(wins)) == 7 / 8
    assert measured.weight_auc_in_step() == 1.0
    swapped = drive(weights[:, ::-1], reliable, alive)
    assert swapped.weight_auc_in_step() == 0.0
    assert np.isnan(Drive(measured.rewards, measured.alive, measured.reliable, None).weight_auc())


def test_evaluation_drives_by_the_mode_of_the_policy() -> None:
    """The same returns as by SB3's own ``predict``, each episode counted to its end and no further."""
    model = make_model("have", 0)
    measured = evaluate(model, n_episodes=3, seed=5)
    env = ReliabilityDriveVecEnv(3)
    env.seed(5)
    observation, returns, over = env.reset(), np.zeros(3), np.zeros(3, bool)
    while not over.all():
        actions, _ = model.predict(observation, deterministic=True)  # type: ignore[arg-type]
        observation, rewards, dones, _ = env.step(actions)
        returns += rewards * ~over
        over |= dones
    np.testing.assert_allclose(measured.returns, returns, rtol=1e-5)
    assert len(set(measured.alive.sum(axis=0))) > 1  # they end at different times


def test_critic_is_compared_with_soft_returns() -> None:
    """Against returns summed up episode by episode."""
    model = make_model("have", 0, ent_coef=0.3)
    bias, correlation = reliability_runs.value_errors(model, n_episodes=2, n_steps=60)
    env = ReliabilityDriveVecEnv(2, max_episode_steps=1000)
    env.seed(reliability_runs.EVALUATION_SEED)
    observation: Any = env.reset()
    th.manual_seed(reliability_runs.EVALUATION_SEED)
    steps: list[list[Any]] = [[], []]
    over = [False, False]
    for _ in range(120):
        tensors = {key: th.as_tensor(value) for key, value in observation.items()}
        with th.no_grad():
            actions, log_prob = model.actor.action_log_prob(model.policy.encode(tensors).flatten(start_dim=1))
            q = th.stack(model.critic(tensors, actions)).min(dim=0).values[:, 0]
        observation, rewards, dones, _ = env.step(actions.numpy())
        for i in range(2):
            if not over[i]:
                steps[i].append((float(q[i]), float(log_prob[i]), float(rewards[i])))
            over[i] |= bool(dones[i])
    assert all(over)  # an untrained driver leaves the road
    pairs = []
    for episode in steps:
        for t in range(min(60, len(episode))):
            rest = episode[t:]
            soft = sum(0.98**k * reward for k, (_, _, reward) in enumerate(rest))
            soft -= sum(0.98**k * 0.3 * log_prob for k, (_, log_prob, _) in enumerate(rest) if k > 0)
            pairs.append((episode[t][0], soft))
    q_values, returns = np.array(pairs).T
    assert bias == pytest.approx((q_values - returns).mean() / returns.std(), rel=1e-3)
    assert correlation == pytest.approx(np.corrcoef(q_values, returns)[0, 1], abs=1e-3)


def test_truth_and_weights_are_of_the_same_moment() -> None:
    """The truth when the action was chosen, beside the weights of that observation."""
    model = make_model("have", 0)
    n = 24
    measured = evaluate(model, n_episodes=n, seed=5)
    env = ReliabilityDriveVecEnv(n)
    env.seed(5)
    observation: Any = env.reset()
    for step in range(15):
        assert measured.reliable[step].tolist() == env.batch.reliable.tolist()
        weights = np.stack(list(model.modality_weights(observation).values()), axis=1)
        assert measured.weights is not None
        np.testing.assert_allclose(measured.weights[step], weights, atol=1e-5)
        actions, _ = model.predict(observation, deterministic=True)
        observation, *_ = env.step(actions)
    assert len(np.unique(measured.reliable[:15], axis=0)) > 1  # they changed meanwhile


def test_kept_return_is_a_share_of_the_clean_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Mean over the modalities that fail, each for whole episodes and with nothing else failing."""
    scores = {"black": 40.0, "frozen": 60.0, "noise": 80.0}

    def returns(model: HAVESAC, corruption: float, failure: tuple[int, str] | None = None) -> Any:
        assert corruption == 0
        score = 100.0 if failure is None else scores[failure[1]] + failure[0]
        return SimpleNamespace(returns=np.array([score - 5, score + 5]))

    monkeypatch.setattr(reliability_runs, "evaluate", returns)
    assert reliability_runs.kept_returns(make_model("gve", 0)) == {
        "clean_return": 100.0,
        "kept_black": pytest.approx(0.41),
        "kept_frozen": pytest.approx(0.61),
        "kept_noise": pytest.approx(0.81),
    }


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    "method,expected", [("have", 0.0), ("have-monotone", 0.0), ("free", 0.5), ("have-distributional", 0.0)]
)
def test_negative_gradient_of_a_run(monkeypatch: pytest.MonkeyPatch, method: str, expected: float) -> None:
    monkeypatch.setattr(reliability_runs, "METHODS", {**METHODS, "free": {"refusion": "free"}})
    share = reliability_runs.run(method, 0, 16)["negative_gradient"]
    assert share == 0.0 if expected == 0 else share > 0.1, share


@pytest.mark.usefixtures("small")
def test_a_run_has_all_measures_and_repeats_itself() -> None:
    first, again = (reliability_runs.run("have", 3, 16) for _ in range(2))
    assert first == again
    assert {"return_8", "return_16", "final_return", "area", "weight_auc", "parameters"} <= first.keys()
    assert first["final_return"] == first["return_16"]
    assert first["area"] == pytest.approx((first["return_8"] + first["return_16"]) / 2)
    assert np.isfinite(list(first.values())).all()
    other = reliability_runs.run("gve", 3, 16)
    assert other.keys() == first.keys()
    assert {name for name, value in other.items() if np.isnan(value)} == {
        "weight_auc",
        "weight_auc_in_step",
        "negative_gradient",
    }


def fake_run(method: str, seed: int, n_updates: int, *given: Any) -> dict[str, float]:
    names = ("final_return", "area", "weight_auc", "value_bias", "kept_black", "kept_frozen", "kept_noise")
    return dict.fromkeys(names, float(seed)) | {"return_10": 1.0, "weight_auc": float("nan")}


def test_runs_are_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[str, int]] = []

    def run(method: str, seed: int, n_updates: int, *given: Any) -> dict[str, float]:
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append((method, seed))
        return fake_run(method, seed, n_updates)

    monkeypatch.setattr(reliability, "run", run)
    arguments = ["--methods", "have", "gve", "--seeds", "2", "--workers", "1", "--out", str(tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        reliability.main(arguments)
    assert made == [("have", 0), ("gve", 0), ("have", 1)]
    monkeypatch.setattr(reliability, "run", fake_run)
    assert reliability.missing(reliability.load(tmp_path), ["have", "gve"], (0, 1), reliability.N_UPDATES) == [
        ("gve", 1)
    ]
    reliability.main(arguments)
    rows = reliability.load(tmp_path)
    assert reliability.missing(rows, ["have", "gve"], (0, 1), reliability.N_UPDATES) == []
    assert not rows.duplicated(["method", "seed", "updates", "measure"]).any()
    assert len(reliability.missing(rows, ["have"], (0, 1), 10)) == 2  # of another length
    assert values(rows, "have", "area").to_dict() == {0: 0.0, 1: 1.0}
    assert values(rows, "have", "weight_auc").empty
    assert not (tmp_path / "report.md").exists()
    monkeypatch.delattr(reliability, "run")
    (tmp_path / "other.csv").write_text("what,else\n1,2\n")  # no runs
    for methods in (["have", "gve"], ["gve", "have"]):
        reliability.main([*arguments, "--report", "--methods", *methods])
        text = (tmp_path / "report.md").read_text()
        assert (text.index("| have |") < text.index("| gve |")) == (methods[0] == "have")


def test_report_of_known_scores() -> None:
    rows = [
        (method, seed, 10, measure, score + seed)
        for method, score in (("have", 10.0), ("gve", 0.0), ("lve", 10.0))
        for measure in ("final_return", "area")
        for seed in range(4)
    ]
    text = report(pd.DataFrame(rows, columns=reliability.COLUMNS), ["lve", "have", "gve", "deaf"])
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in text.splitlines() if line.startswith("| ")}
    improvements = text.split("## Probability")[1]
    assert "| gve | 1.00 [1.00, 1.00] |" in improvements
    assert "| lve | 0.50 [" in improvements
    assert "11.5 ± 1.1" in text and lines["method"]
    scores = text.split("\n## ")[0]
    assert scores.index("| lve ") < scores.index("| have ") < scores.index("| gve "), "the order that was asked for"
    assert improvements.index("| lve ") < improvements.index("| gve ")
    assert "deaf" not in text, "it has no runs"


def test_lead_under_a_failure_is_in_returns_and_not_in_shares() -> None:
    measures = {"final_return": 1.0, "area": 1.0, "kept_black": 0.5, "kept_frozen": 0.8, "kept_noise": 1.0}
    rows = [
        (method, seed, 10, measure, value)
        for method, clean in (("have", 100.0), ("gve", 60.0))
        for measure, value in {**measures, "clean_return": clean}.items()
        for seed in range(2)
    ]
    text = report(pd.DataFrame(rows, columns=reliability.COLUMNS), ["have", "gve"])
    assert "| gve | 20.0 [20.0, 20.0] | 32.0 [32.0, 32.0] | 40.0 [40.0, 40.0] |" in text


def test_small_runs_are_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reliability, "run", fake_run)
    table = reliability.run_small(seeds=(1, 0), n_updates=16, n_workers=1)
    assert table.index.tolist() == [0, 1]
    assert table["final_return"].tolist() == [0.0, 1.0]
    assert set(table.columns) == {*fake_run("have", 0, 16), "seconds"}
