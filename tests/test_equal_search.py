"""The search with equal effort: the same trials for every method, the best trained anew with other seeds."""

from pathlib import Path
from typing import Any

import pytest

from benchmarks import equal_search, reliability, reliability_runs
from benchmarks.equal_search import SEARCH_SEEDS, SPACE, draw_trials
from benchmarks.reliability_runs import EVALUATION_SEED, HYPERPARAMETERS, make_model

Made = list[tuple[str, int, float]]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    """
    Runs (method, seed, learning rate) in the order in which they are made, by a method that measures instead of trains:
    "gve" likes large learning rates and "have" small ones; with seeds not of the search both are ten times as good.
    """
    made: Made = []

    def run(
        method: str, seed: int, n_updates: int, task: Any, hyperparameters: Any, evaluation_seed: int
    ) -> dict[str, float]:
        assert (evaluation_seed == EVALUATION_SEED) == (seed not in SEARCH_SEEDS)
        learning_rate = hyperparameters["learning_rate"]
        made.append((method, seed, learning_rate))
        area = (learning_rate if method == "gve" else 1 / learning_rate) * (1 if seed in SEARCH_SEEDS else 10)
        names = ("final_return", "weight_auc", "value_bias", "kept_black", "kept_frozen", "kept_noise", "clean_return")
        return {**dict.fromkeys(names, 1.0), "area": area}

    monkeypatch.setattr(reliability, "run", run)
    return made


def test_trials_are_the_benchmark_s_own_and_then_drawn() -> None:
    trials = draw_trials(6)
    assert trials[0] == {name: HYPERPARAMETERS[name] for name in SPACE}
    assert draw_trials(9)[:6] == trials, "more trials must not change the first ones"
    assert len({tuple(trial.values()) for trial in trials}) == 6
    assert all(3e-4 <= t["learning_rate"] <= 3e-3 and 3e-3 <= t["tau"] <= 3e-2 for t in draw_trials(50))


def test_every_method_has_the_same_trials_and_its_best_has_new_seeds(tmp_path: Path, made: Made) -> None:
    arguments = ["--methods", "gve", "have", "--trials", "3", "--workers", "1", "--out", str(tmp_path)]
    equal_search.main(arguments)
    rates = [trial["learning_rate"] for trial in draw_trials(3)]
    for method, best in (("gve", max(rates)), ("have", min(rates))):
        searched = [run for run in made if run[0] == method and run[1] in SEARCH_SEEDS]
        assert searched == [(method, seed, rate) for rate in rates for seed in SEARCH_SEEDS]
        after = [run for run in made if run[0] == method and run[1] not in SEARCH_SEEDS]
        assert after == [(method, seed, best) for seed in range(equal_search.N_SEEDS)]
    made.clear()
    equal_search.main([*arguments, "--report"])
    text = (tmp_path / "report.md").read_text()
    assert text.count("**") == 4, "one best trial for each of two methods"
    assert f"| gve | 8 | 1.0 [1.0, 1.0] | 1.0 ± 0.0 | {max(rates) * 10:.1f} [" in text
    assert not made, "runs that are there are not repeated"
    with pytest.raises(FileNotFoundError, match="gve lacks runs of trial 3; run without --report"):
        equal_search.main([*arguments, "--trials", "4", "--report"])


def test_a_stopped_search_goes_on(tmp_path: Path, made: Made) -> None:
    trials = draw_trials(2)
    equal_search.search(["gve"], trials[:1], 10, 1, tmp_path)
    n_runs = len(made)
    file = tmp_path / "trial-0" / "gve.csv"
    file.write_text("".join(line for line in file.read_text().splitlines(keepends=True) if ",200," not in line))
    equal_search.search(["gve"], trials[:1], 10, 1, tmp_path)
    assert made[n_runs:] == [("gve", 200, trials[0]["learning_rate"])]


def test_runs_of_other_trials_are_refused(tmp_path: Path, made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["--methods", "gve", "--workers", "1", "--out", str(tmp_path), "--trials"]
    equal_search.main([*arguments, "3"])
    equal_search.main([*arguments, "2"])
    assert len((tmp_path / "trials.csv").read_text().splitlines()) == 1 + 3, "the record keeps what there was"
    drawn = draw_trials(3)
    monkeypatch.setattr(equal_search, "draw_trials", lambda n_trials: [drawn[0], {**drawn[1], "tau": 0.5}, drawn[2]])
    with pytest.raises(ValueError, match=r"trials\.csv has other trials .* choose another --out"):
        equal_search.main([*arguments, "3"])


def test_hyperparameters_reach_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    trial = draw_trials(2)[1]
    seen: dict[str, Any] = {}

    def watched(*args: Any, **kwargs: Any) -> Any:
        seen.update(kwargs)
        raise KeyboardInterrupt

    monkeypatch.setattr(reliability_runs, "make_model", watched)
    with pytest.raises(KeyboardInterrupt):
        reliability_runs.run("have", 0, 16, None, trial)
    assert seen == trial
    model = make_model("have", 0, **trial)
    assert [getattr(model, name) for name in SPACE] == [trial[name] for name in SPACE]
