"""Tables of a benchmark, against values computed by hand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from benchmark_results import (
    NIGHT,
    NOON,
    STD,
    evaluations,
    failure_rows,
    final,
    moments,
    read,
    run_rows,
    write,
)
from matplotlib.figure import Figure

from sb3_have.benchmark import tables
from sb3_have.benchmark.reading import DISTANCE, RETURN, Results
from sb3_have.benchmark.report import write_report
from sb3_have.evaluation.evaluation import markdown_table


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return read(tmp_path / "core", final=final(), evaluations=evaluations(), runs=run_rows())


@pytest.fixture
def words_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip drawing, which takes most of a report's time."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: Path(path).touch())


def cell(table: pd.DataFrame, weather: str, driver: str, measure: str = "distance") -> dict[str, Any]:
    chosen = (table["weather"] == weather) & (table["driver"] == driver) & (table["measure"] == measure)
    (row,) = table[chosen].to_dict("records")
    return {str(key): value for key, value in row.items()}


# Table 1


def test_weather_table_by_hand(results: Results) -> None:
    table = tables.weather_table(results)
    assert list(dict.fromkeys(table["weather"])) == [NOON, NIGHT, "all"]
    noon, everywhere = cell(table, NOON, "have"), cell(table, "all", "have")
    assert noon["mean"] == 225 and noon["std"] == pytest.approx(150 / 2**0.5) and noon["spread"] == "seeds"
    assert noon["seeds"] == 2 and noon["episodes"] == 4 and everywhere["episodes"] == 8
    # the seeds' means over the weathers are 170 and 275, and 150 and 150
    assert everywhere["mean"] == 222.5 and everywhere["std"] == pytest.approx(105 / 2**0.5)
    assert cell(table, "all", "sac")["mean"] == 150 and cell(table, "all", "sac")["std"] == 0
    assert cell(table, "all", "have", "return")["mean"] == pytest.approx(22.25 - 5)
    assert table.loc[table["best"], "driver"].unique().tolist() == ["have"]


def test_single_seed_spreads_over_episodes(tmp_path: Path) -> None:
    table = tables.weather_table(read(tmp_path, final=final({"sac": {0: (100, 200)}})))
    noon, everywhere = cell(table, NOON, "sac"), cell(table, "all", "sac")
    assert (noon["mean"], noon["std"], noon["spread"], noon["seeds"]) == (100, STD, "episodes", 1)
    # of four episodes, two about 100 and two about 200
    assert everywhere["mean"] == 150 and everywhere["std"] == pytest.approx((STD**2 + 50**2) ** 0.5)


def test_best_is_bold_and_drivers_are_not(tmp_path: Path) -> None:
    drivers = [{"driver": "IDM", "weather": weather, **moments(2134)} for weather in (NOON, NIGHT)]
    runs = {"have": {0: (150, 100)}, "sac": {0: (100, 200)}}
    results = read(tmp_path, final=final(runs), drivers=drivers)
    lines = tables.weather_markdown(results, tables.weather_table(results)).splitlines()
    assert [part.strip() for part in lines[0].split("|")[1:-1]] == ["weather", "", "sac (1)", "have (1)", "IDM"]
    assert [part.strip() for part in lines[3].split("|")[1:-1]] == [
        NOON,
        "D [m]",
        "100 ± 30",
        "**150** ± 30",
        "2134 ± 30",
    ]
    assert [part.strip() for part in lines[2].split("|")[1:-1]][2:] == ["5.0 ± 3.0", "**10.0** ± 3.0", "208.4 ± 3.0"]
    assert "**200** ± 30" in lines[5] and "**150**" in lines[7] and len(lines) == 2 + 3 * 2


def test_driver_without_all_weathers_has_no_total(tmp_path: Path) -> None:
    results = read(tmp_path, final=final(), drivers=[{"driver": "IDM", "weather": NOON, **moments(2134)}])
    table = tables.weather_table(results)
    assert table.loc[table["driver"] == "IDM", "weather"].unique().tolist() == [NOON]
    last = tables.weather_markdown(results, table).splitlines()[-1]
    assert last.split("|")[-2].strip() == "–"


@pytest.mark.usefixtures("words_only")
def test_drivers_are_reported_beside_the_methods(tmp_path: Path) -> None:
    drivers = [{"driver": "IDM", "weather": weather, **moments(2134)} for weather in (NOON, NIGHT)]
    report = write_report(write(tmp_path / "a", final=final(), drivers=drivers)).read_text()
    assert "- Untrained drivers: `IDM` 2134 m.\n" in report


def test_newest_complete_step_counts(tmp_path: Path) -> None:
    longer = final({"sac": {0: (400, 500)}}, step=4000)
    unfinished = final({"sac": {0: (900,)}}, step=6000)
    results = read(tmp_path, final=[*final(), *longer, *unfinished])
    np.testing.assert_array_equal(results.scores("sac", DISTANCE), [[400, 500], [140, 160]])
    (sac,) = (row for row in tables.run_table(results).to_dict("records") if row["method"] == "sac")
    assert sac["steps"] == "2000 / 4000"


@pytest.mark.usefixtures("words_only")
def test_environment_without_distance(tmp_path: Path) -> None:
    unknown = {"distance_mean": None, "distance_std": None}
    results = read(tmp_path, final=[row | unknown for row in final()], evaluations=[r | unknown for r in evaluations()])
    assert results.measures == [RETURN]
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "D [m]" not in report and "IQM of return" in report and not re.search(r"\bnan\b", report)


# Table 2 and statistics


def test_ablation_leaves_out_what_is_no_part_of_it(tmp_path: Path) -> None:
    runs = {"sac": {0: (1, 2)}, "lve": {0: (100, 200)}, "have": {0: (200, 300)}}
    results = read(tmp_path, final=final(runs), runs=run_rows(runs))
    table = tables.ablation_table(results)
    assert table["method"].tolist() == ["lve", "have"] and table["parameters"].tolist() == ["1234", "1234"]
    assert table["distance_mean"].tolist() == [150, 250]
    last = tables.ablation_markdown(results, table).splitlines()[-1]
    assert "**250** ± 58" in last and "**20.0** ± 5.8" in last


def test_statistics_by_hand(results: Results) -> None:
    rows = tables.score_table(results).to_dict("records")
    sac, have = (row for row in rows if row["measure"] == "distance")
    # of 150, 190, 250, 300 and 100, 140, 160, 200 the middle ones
    assert have["iqm"] == 220 and sac["iqm"] == 150
    # at noon 4 of 4 pairs, at night 3 of 4
    assert sac["improvement"] == 7 / 8 and np.isnan(have["improvement"])


def test_areas_by_hand(tmp_path: Path) -> None:
    """Unfinished runs are left out, and steps at which only one run was evaluated."""
    rows = evaluations(shares={1000: 0.5, 2000: 1.0})
    rows += final({"have": {0: (9000.0, 9000.0)}}, step=1500) + final({"have": {2: (9000.0, 9000.0)}}, step=1000)
    results = read(tmp_path, final=final(), evaluations=rows)
    assert results.shared_steps() == [1000, 2000]
    np.testing.assert_allclose(results.areas("have", DISTANCE), 0.75 * results.scores("have", DISTANCE))
    table = tables.score_table(results, areas=True)
    sac, have = (row for row in table.to_dict("records") if row["measure"] == "distance")
    assert have["iqm"] == 0.75 * 220 and sac["improvement"] == 7 / 8
    assert tables.score_table(read(tmp_path / "none", final=final()), areas=True).empty


def test_intervals_draw_whole_seeds(tmp_path: Path) -> None:
    """With single scores, no interval would reach from the lowest seed's mean to the highest one's."""
    runs = {"sac": {0: (100, 200), 1: (140, 160), 2: (150, 150)}, "have": {i: (200 + i, 400 + i) for i in range(3)}}
    sac, have = tables.score_table(read(tmp_path, final=final(runs))).tail(2).to_dict("records")
    assert (have["iqm_lower"], have["iqm_upper"]) == (300, 302)
    assert sac["iqm_lower"] == sac["iqm_upper"] == 150
    assert (sac["improvement_lower"], sac["improvement_upper"]) == (1, 1)


@pytest.mark.usefixtures("words_only")
@pytest.mark.parametrize("seeds", [1, 2])
def test_no_interval_from_so_few_seeds(tmp_path: Path, seeds: int) -> None:
    runs = {name: dict.fromkeys(range(3), (100, 200)) for name in ("sac", "have")}
    runs["lve"] = dict.fromkeys(range(seeds), (160, 180))
    results = read(tmp_path, final=final(runs))
    table = tables.score_table(results)
    lve = table[(table["method"] == "lve") & (table["measure"] == "distance")].iloc[0]
    assert lve["iqm"] == 170 and lve["improvement"] == 0.5
    assert lve[["iqm_lower", "iqm_upper", "improvement_lower", "improvement_upper"]].isna().all()
    assert np.isfinite(table.loc[table["method"] != "lve", "iqm_lower"]).all()
    text = tables.score_markdown(table, DISTANCE, "have").splitlines()
    assert [part.strip() for part in text[3].split("|")[1:-1]] == ["lve", str(seeds), "170", "0.50"]
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "lve: fewer than 3 seeds, hence no interval" in report and "unknown for lack of seeds for `lve`" in report


def test_minutes_are_those_of_an_ordinary_run(tmp_path: Path) -> None:
    """A single run on a busy machine does not matter."""
    runs = {"have": dict.fromkeys(range(3), (100, 200))}
    rows = [row | {"minutes": minutes} for row, minutes in zip(run_rows(runs), (15.0, 13.0, 130.0), strict=True)]
    (row,) = tables.run_table(read(tmp_path, final=final(runs), runs=rows)).to_dict("records")
    assert row["minutes"] == 15


def named(table: pd.DataFrame) -> dict[tuple[str, str], dict[str, Any]]:
    """Rows by method, and modality and kind."""
    rows = table.to_dict("records")
    return {(row["method"], f"{row['modality']} {row['kind']}"): {str(k): v for k, v in row.items()} for row in rows}


@pytest.mark.usefixtures("words_only")
def test_failures_by_hand(tmp_path: Path) -> None:
    # returns 5 -> 1 and 15 -> 6; lve's 5 -> 1 and -1 -> -3
    given = {"have": {0: (100.0, 60.0), 1: (200.0, 110.0)}, "lve": {0: (100.0, 60.0), 1: (40.0, 20.0)}}
    results = read(tmp_path, final=final(), failures=failure_rows(given))
    table = tables.failure_table(results)
    assert list(named(table)) == [(m, case) for m in ("lve", "have") for case in ("none none", "rgb black")]
    sound, have, lve = (named(table)[k] for k in (("have", "none none"), ("have", "rgb black"), ("lve", "rgb black")))
    assert (sound["return_mean"], sound["distance_mean"], sound["distance_kept"], sound["seeds"]) == (10, 150, 1, 2)
    assert (have["return_mean"], have["return_lowest"], have["return_highest"]) == pytest.approx((3.5, 1, 6))
    assert have["distance_mean"] == 85 and have["distance_std"] == pytest.approx(50 / 2**0.5)
    # of the means, not the mean of 0.6 and 0.55, or of the returns 0.2 and 3
    assert have["distance_kept"] == pytest.approx(85 / 150)
    assert (lve["return_mean"], lve["return_kept"]) == pytest.approx((-1, -0.5))
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "| have (2) | 10.0 ± 7.1 | 3.5 ± 3.5  |" in report and "| have (2) | 150 ± 71 | 85 ± 35   |" in report
    assert "| over lve | +8.0 | +4.5      |" in report and "| over lve | +80  | +45       |" in report
    assert "| have   | 0.57      |" in report and "Black = frozen" not in report


@pytest.mark.usefixtures("words_only")
def test_frozen_that_is_black_counts_once(tmp_path: Path) -> None:
    rows = failure_rows({"have": {0: (100.0, 60.0)}, "sac": {0: (90.0, 50.0)}}, "event")
    rows += [row for row in failure_rows({"have": {0: (100.0, 70.0)}}) if row["kind"] == "black"]
    rows += [row | {"kind": "frozen"} for row in rows if row["kind"] == "black"]
    rows[-1] |= moments(75, 1)  # of rgb
    results = read(tmp_path, final=final(), failures=rows)
    table = tables.failure_table(results)
    assert [case for method, case in named(table) if method == "have"] == [
        *("none none", "event black = frozen", "rgb black", "rgb frozen"),
    ]
    assert named(table)["sac", "event black = frozen"]["distance_mean"] == 50
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "Black = frozen: frozen from the reset on, an event camera shows no events" in report
    assert "| sac (1)  | 90   | 50                   | –         | –          |" in report


def test_markdown_escapes_and_lines_up() -> None:
    assert markdown_table(["a|b", "c"], [["1", "long"]]) == "| a\\|b | c    |\n|------|------|\n| 1    | long |"
