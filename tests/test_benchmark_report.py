"""The report of a benchmark: its sections, missing runs, and files that cannot be read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from benchmark_results import (
    DISTANCES,
    NIGHT,
    Runs,
    evaluations,
    failure_rows,
    final,
    run_rows,
    weight_rows,
    write,
)
from matplotlib.figure import Figure

from sb3_have.benchmark.provenance import flatten
from sb3_have.benchmark.reading import ResultsError, read_csv, read_results
from sb3_have.benchmark.report import main, write_report


@pytest.fixture
def words_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip drawing, which takes most of a report's time."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: Path(path).touch())


def cells(report: str, first: str) -> list[str]:
    """The cells of the first line of a table that begins with this word."""
    (found, *_) = [line for line in report.splitlines() if line.startswith(f"| {first} ")]
    return [text.strip() for text in found.strip("|").split("|")]


# Half a benchmark


@pytest.mark.usefixtures("words_only")
def test_missing_runs_without_a_grid(tmp_path: Path) -> None:
    partial: Runs = {"lve": {0: (100,)}, **DISTANCES}
    begun = evaluations({"gve-wide": {1: (10, 20)}}, {1000: 1.0})
    write(tmp_path / "core", final=final(partial), evaluations=[*evaluations(), *begun])
    report = write_report(tmp_path / "core").read_text()
    assert "Missing, if every method is to have every seed:" in report
    assert "- `gve-wide`: seed under way: 1 (at 1000); seed not begun: 0\n" in report
    assert "- `lve`: seed under way: 0 (at 2000, 1 of 2 weathers); seed not begun: 1\n" in report
    assert "`have`: seed" not in report and "no `runs.csv`" in report
    assert cells(report, "weather") == ["weather", "", "sac (2)", "have (2)"]


@pytest.mark.usefixtures("words_only")
def test_missing_runs_of_a_grid(tmp_path: Path) -> None:
    folder = write(tmp_path / "results" / "core", final=final())
    assert "Every method has every seed." in write_report(folder).read_text()
    (tmp_path / "grids").mkdir()
    grid = tmp_path / "grids" / "core.yml"
    grid.write_text("methods: [sac, have, mine/new.yml]\nseeds: [0, 1, 2]\n")
    report = write_report(folder).read_text()
    assert "Missing, of the grid:" in report and "- `new`: seed not begun: 0, 1, 2\n" in report
    assert "- `have`: seed not begun: 2\n" in report and f"run {grid.as_posix()}" in report
    grid.write_text("methods: [sac, have]\nseeds: [0, 1]\n")
    assert "The grid is finished." in write_report(folder).read_text()


@pytest.mark.usefixtures("words_only")
def test_each_grid_has_seeds_of_its_own(tmp_path: Path) -> None:
    folders = [write(tmp_path / name, final=final({name: DISTANCES["have"]})) for name in ("have", "sac")]
    grids = [tmp_path / f"{name}.yml" for name in ("have", "sac")]
    grids[0].write_text("methods: [have]\nseeds: [0, 1]\n")
    grids[1].write_text("methods: [sac]\nseeds: [0, 1, 2]\n")
    report = write_report(folders, tmp_path / "out", grids=grids).read_text()
    assert "- `sac`: seed not begun: 2\n" in report and "- `have`: seed" not in report


@pytest.mark.usefixtures("words_only")
def test_report_before_any_run_is_finished(tmp_path: Path) -> None:
    write(tmp_path, evaluations=evaluations(shares={1000: 0.5}))
    (tmp_path / "final.csv").write_text(",".join(final()[0]) + "\n")
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "No run is finished yet" in report and "learning_curves.png" in report and "Table 1" not in report


@pytest.mark.usefixtures("words_only")
def test_report_without_the_reference(tmp_path: Path) -> None:
    report = write_report(write(tmp_path / "a", final=final({"sac": DISTANCES["sac"]}))).read_text()
    assert "`have` has no finished run." in report and "improvement.png" not in report
    assert "Needs finished runs of two of" in report


@pytest.mark.usefixtures("words_only")
def test_runs_of_different_lengths(tmp_path: Path) -> None:
    write(tmp_path / "a", final=final({"sac": DISTANCES["sac"]}))
    write(tmp_path / "b", final=final({"have": DISTANCES["have"]}, step=90_000))
    report = write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out").read_text()
    assert "**Runs of different lengths are side by side**: 2,000 and 90,000 steps." in report


# The report


def test_whole_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = {"return": 8.0, "distance": 70.0, "steps": 20, "crashed": True, "offroad": False}
    episodes = [{"method": "have", "seed": 0, "weather": NIGHT, "episode_seed": i, **ends} for i in range(3)]
    episodes.append({**episodes[0], "episode_seed": 9, "steps": 60, "crashed": False})
    write(
        tmp_path / "core",
        final=final(),
        evaluations=evaluations(),
        runs=run_rows(policy_kwargs={"features_dim": 50}),
        episodes=episodes,
        weights=weight_rows({0: [0.2, 0.4]}),
        failures=failure_rows({"have": {0: (100.0, 60.0)}}),
    )
    out = tmp_path / "out"
    main([str(tmp_path / "core"), "--out", str(out)])
    assert capsys.readouterr().out.strip() == str(out / "report.md")
    report = (out / "report.md").read_text()
    pictures = re.findall(r"\]\((\w+\.png)\)", report)
    assert set(pictures) == {path.name for path in out.glob("*.png")} and len(pictures) == 8
    assert all(path.stat().st_size > 5000 for path in out.glob("*.png"))
    for name in re.findall(r"`(table_\w+\.csv)`", report):
        assert len(pd.read_csv(out / name))
    assert "`have` is first in distance in 2 of 2 weathers." in report
    assert "is better in distance while training, its 95% interval: unknown for lack of seeds for `sac`" in report
    assert "at steps 1,000 and 2,000. It shows which method learns sooner." in report
    assert "best first: `have` 222 m, `sac` 150 m." in report
    assert "| have   | 4        | 0.75    | 0.00          | 30         |" in report
    assert "gamma: 0.9\npolicy_kwargs.features_dim: 50\n" in report and '| sac    | name    | "sac"  |' in report
    assert "- a machine (4 runs)" in report and "- torch 2 (4 runs)" in report


@pytest.mark.usefixtures("words_only")
def test_weathers_that_others_win(tmp_path: Path) -> None:
    runs = {"have": {0: (150, 100)}, "sac": {0: (100, 200)}}
    report = write_report(write(tmp_path / "a", final=final(runs))).read_text()
    assert f"`have` is first in distance in 1 of 2 weathers; not in {NIGHT} (`sac`)." in report
    level: Runs = {"have": {0: (150, 100)}, "sac": {0: (150, 100)}}
    report = write_report(write(tmp_path / "b", final=final(level))).read_text()
    assert "`have` is first or level in distance in 2 of 2 weathers." in report


def test_same_results_same_bytes(tmp_path: Path) -> None:
    folder = write(tmp_path / "core", evaluations=evaluations())
    first, second = (write_report(folder, tmp_path / out).parent / "learning_curves.png" for out in ("a", "b"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.usefixtures("words_only")
def test_intervals_in_words(tmp_path: Path) -> None:
    seeds = {"have": (30, 50, 40), "rgb": (10, 20, 15, 16), "sac": (40, 41, 42), "lve": (60, 70, 65), "drq": (1, 1)}
    runs: Runs = {name: {i: (a, a) for i, a in enumerate(scores)} for name, scores in seeds.items()}
    report = write_report(write(tmp_path / "a", final=final(runs))).read_text()
    groups = "above 0.5 for `rgb`; including 0.5 for `sac`; below 0.5 for `lve`; unknown for lack of seeds for `drq`"
    few = (
        "from 3 to 4 seeds; with three, such intervals contain the true value in about 75% of cases, with eight in 90%"
    )
    assert f"Probability that `have` is better in distance, its 95% interval ({few}): {groups}." in report


@pytest.mark.usefixtures("words_only")
def test_noise_of_the_learning_curves_in_words(tmp_path: Path) -> None:
    """Two weathers with two final episodes each, whose standard deviation is 30 m (ddof 0)."""
    one_each = [row | {"episodes": 1} for row in evaluations(shares={1000: 0.5})]
    report = write_report(write(tmp_path / "a", final=final(), evaluations=one_each)).read_text()
    assert "A seed's point of 2 episodes has a standard error of ±30 m in distance and ±3.0 in return" in report
    single = [row | {"episodes": 1} for row in final()]
    report = write_report(write(tmp_path / "b", final=single, evaluations=one_each)).read_text()
    assert "A point of few episodes is noisy" in report


def test_settings_by_dotted_names() -> None:
    assert flatten({"a": {"b": 1, "c": {"d": [2]}}, "e": {}}) == {"a.b": 1, "a.c.d": [2], "e": {}}


# Wrong files


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        (
            "final.csv",
            ("sac,1,ClearNight", "sac,x,ClearNight"),
            "final.csv, line 5: seed: expected int, got 'x'",
        ),
        ("final.csv", ("sac,1,ClearNight", "sac,1.5,ClearNight"), "line 5: seed: expected int, got '1.5'"),
        ("final.csv", (",160,", ",inf,"), "line 5: distance_mean: expected float, got 'inf'"),
        ("final.csv", (",11.0,", ",,"), "line 5: return_mean: expected float, got ''"),
        ("final.csv", ("sac,1,ClearNight", "sac,1,"), "line 5: weather: expected str, got ''"),
        ("final.csv", ("sac,1,ClearNight", "sac,1,ClearNight,9"), "final.csv: .*Expected 9 fields in line 5, saw 10"),
        (
            "final.csv",
            ("weather", "wheather"),
            "expected the columns method, .* got method, seed, wheather, ",
        ),
        (
            "final.csv",
            ("seed,weather", "seed,seed,weather"),
            "expected the columns method, .* got method, seed, seed, weather, ",
        ),
        (
            "final.csv",
            ("sac,1,ClearNight", "sac,0,ClearNight"),
            r"twice, in .*, line 3 and .*, line 5: method sac, seed 0",
        ),
        ("runs.csv", (",1234,", ",,"), "runs.csv, line 2: parameters: expected int, got ''"),
    ],
)
def test_broken_file_is_named_with_its_line(tmp_path: Path, name: str, change: tuple[str, str], words: str) -> None:
    path = write(tmp_path, final=final(), runs=run_rows()) / name
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises(ResultsError, match=words):
        read_results([tmp_path])
    with pytest.raises(SystemExit, match=words):
        main([str(tmp_path)])


def test_empty_cut_and_absent_files(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=r"neither final\.csv nor evaluations\.csv"):
        read_results([tmp_path])
    (tmp_path / "final.csv").write_text("")
    with pytest.raises(ResultsError, match=r"final\.csv is empty"):
        read_results([tmp_path])
    path = write(tmp_path, final=final()) / "final.csv"
    path.write_text(path.read_text()[:-1])
    with pytest.raises(ResultsError, match="cut off"):
        read_results([tmp_path])


def test_run_in_two_folders_is_refused(tmp_path: Path) -> None:
    folders = [write(tmp_path / name, final=final()) for name in ("core", "again")]
    with pytest.raises(
        ResultsError, match=r"core.final\.csv, line 2 and .*again.final\.csv, line 2: method sac, seed 0"
    ):
        read_results(folders)


def test_folders_are_joined(tmp_path: Path) -> None:
    write(tmp_path / "core", final=final({"sac": DISTANCES["sac"]}), evaluations=evaluations())
    write(tmp_path / "more", final=final({"have": DISTANCES["have"], "a-new-one": {0: (1, 2)}}))
    results = read_results([tmp_path / "core", tmp_path / "more"])
    assert results.methods == results.scored() == ["sac", "have", "a-new-one"]
    assert results.finished_seeds("a-new-one") == [0]


def test_types_of_what_is_read(tmp_path: Path) -> None:
    ends = {"return": 8, "distance": "", "steps": 20.0, "crashed": True, "offroad": ""}
    rows = [{"method": "have", "seed": 0, "weather": "none", "episode_seed": 4_294_967_295, **ends}]
    frame = read_csv(write(tmp_path, episodes=rows) / "episodes.csv")
    (row,) = frame.to_dict("records")
    assert (row["episode_seed"], row["steps"], row["crashed"], row["weather"]) == (4_294_967_295, 20, 1, "none")
    assert np.isnan(row["distance"]) and np.isnan(row["offroad"])


@pytest.mark.usefixtures("words_only")
def test_report_where_no_sensor_could_fail(tmp_path: Path) -> None:
    rows = [row for row in failure_rows({"have": {0: (100.0, 60.0)}}) if row["kind"] == "none"]
    write(tmp_path / "core", final=final(), failures=rows)
    assert "When a sensor fails" not in write_report(tmp_path / "core").read_text()
