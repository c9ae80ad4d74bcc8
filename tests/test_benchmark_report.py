"""The benchmark's report: what stands in its tables and figures is what the runs wrote, and no more than that."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from sb3_have.benchmark import figures, tables
from sb3_have.benchmark.reading import DISTANCE, RETURN, Results, ResultsError, read_csv, read_results
from sb3_have.benchmark.report import flatten, main, write_report

Rows = list[dict[str, Any]]
Runs = Mapping[str, Mapping[int, tuple[float, ...]]]

NOON, NIGHT = "ClearNoon", "ClearNight"
# distance of each seed at noon and at night; the return is distance / 10 - 5
DISTANCES: Runs = {"sac": {0: (100, 200), 1: (140, 160)}, "have": {0: (150, 190), 1: (300, 250)}}
STEPS, STD, EPISODES = 2000, 30.0, 2


def moments(distance: float, episodes: int = EPISODES) -> dict[str, Any]:
    told = {"return_mean": distance / 10 - 5, "return_std": STD / 10, "distance_mean": distance, "distance_std": STD}
    return {**told, "episodes": episodes}


def each(runs: Runs) -> list[tuple[dict[str, Any], float]]:
    """Method, seed and weather of each score, and the score."""
    return [
        ({"method": method, "seed": seed, "weather": weather}, distance)
        for method, seeds in runs.items()
        for seed, distances in seeds.items()
        for weather, distance in zip((NOON, NIGHT), distances, strict=False)
    ]


def final(runs: Runs = DISTANCES, step: int = STEPS) -> Rows:
    return [{**key, "step": step, **moments(distance)} for key, distance in each(runs)]


def evaluations(runs: Runs = DISTANCES, shares: Mapping[int, float] = {1000: 0.5, 2000: 1.0}) -> Rows:
    return [row for step, share in shares.items() for row in final(scaled(runs, share), step)]


def scaled(runs: Runs, share: float) -> Runs:
    return {name: {seed: tuple(share * d for d in ds) for seed, ds in seeds.items()} for name, seeds in runs.items()}


def run_rows(runs: Runs = DISTANCES, **settings: Any) -> Rows:
    told = {"steps": STEPS, "parameters": 1234, "minutes": 10.0, "machine": "a machine", "versions": "torch 2"}
    return [
        {"method": method, "seed": seed, **told, "settings": json.dumps({"gamma": 0.9, "name": method, **settings})}
        for method, seeds in runs.items()
        for seed in seeds
    ]


def weight_rows(weights: Mapping[int, Sequence[float]], method: str = "have", weather: str = NIGHT) -> Rows:
    """Weights of rgb by seed, a number for each step."""
    key = {"method": method, "weather": weather, "episode_seed": 7}
    return [
        {**key, "seed": seed, "t": t, "modality": modality, "weight": weight, "return_so_far": float(t)}
        for seed, values in weights.items()
        for t, rgb in enumerate(values)
        for modality, weight in (("rgb", rgb), ("event", 1 - rgb))
    ]


def failure_rows(kept: Mapping[str, Mapping[int, tuple[float, float]]], modality: str = "rgb") -> Rows:
    """Distances without and with a black picture, by method and seed; the return is distance / 10 - 5."""
    rows = []
    for method, seeds in kept.items():
        for seed, (healthy, black) in seeds.items():
            key = {"method": method, "seed": seed, "weather": NIGHT}
            rows.append({**key, "modality": "none", "kind": "none", "severity": 0, **moments(healthy, 1)})
            rows.append({**key, "modality": modality, "kind": "black", "severity": 3, **moments(black, 1)})
    return rows


def write(folder: Path, **files: Rows) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in files.items():
        pd.DataFrame(rows).to_csv(folder / f"{name}.csv", index=False)
    return folder


def read(folder: Path, **files: Rows) -> Results:
    return read_results([write(folder, **files)])


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return read(tmp_path / "core", final=final(), evaluations=evaluations(), runs=run_rows())


@pytest.fixture
def words_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are not drawn, which takes most of a report's time."""
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: Path(path).touch())


def cell(table: pd.DataFrame, weather: str, driver: str, measure: str = "distance") -> dict[str, Any]:
    chosen = (table["weather"] == weather) & (table["driver"] == driver) & (table["measure"] == measure)
    (row,) = table[chosen].to_dict("records")
    return {str(key): value for key, value in row.items()}


def line(axis: Axes, label: str) -> Line2D:
    (found,) = [line for line in axis.get_lines() if str(line.get_label()) == label]
    return found


def points(drawn: Line2D) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in np.column_stack([drawn.get_xdata(), drawn.get_ydata()])]


def panel(figure: Figure, words: str) -> Axes:
    (found,) = [axis for axis in figure.axes if words in axis.get_xlabel() + axis.get_ylabel() + axis.get_title()]
    return found


def bars(axis: Axes) -> dict[str, list[float]]:
    """Heights of the bars by colour."""
    groups = [group for group in axis.containers if isinstance(group, BarContainer)]
    return {to_hex(group.patches[0].get_facecolor()): [bar.get_height() for bar in group.patches] for group in groups}


def whiskers(axis: Axes) -> list[list[float]]:
    """Lowest and highest of each."""
    paths = [np.asarray(path.vertices, float) for group in axis.collections for path in group.get_paths()]
    return [[float(y) for y in path[:, 1]] for path in paths]


def cells(report: str, first: str) -> list[str]:
    """Of the first line of the tables of a report that begins so."""
    (found, *_) = [line for line in report.splitlines() if line.startswith(f"| {first} ")]
    return [text.strip() for text in found.strip("|").split("|")]


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
def test_drivers_are_told_beside_the_methods(tmp_path: Path) -> None:
    drivers = [{"driver": "IDM", "weather": weather, **moments(2134)} for weather in (NOON, NIGHT)]
    report = write_report(write(tmp_path / "a", final=final(), drivers=drivers)).read_text()
    assert "- Drivers that did not learn: `IDM` 2134 m.\n" in report


def test_newest_complete_step_counts(tmp_path: Path) -> None:
    longer = final({"sac": {0: (400, 500)}}, step=4000)
    unfinished = final({"sac": {0: (900,)}}, step=6000)
    results = read(tmp_path, final=[*final(), *longer, *unfinished])
    np.testing.assert_array_equal(results.scores("sac", DISTANCE), [[400, 500], [140, 160]])
    (sac,) = (row for row in tables.run_table(results).to_dict("records") if row["method"] == "sac")
    assert sac["steps"] == "2000 / 4000"


@pytest.mark.usefixtures("words_only")
def test_environment_without_distance(tmp_path: Path) -> None:
    untold = {"distance_mean": None, "distance_std": None}
    results = read(tmp_path, final=[row | untold for row in final()], evaluations=[r | untold for r in evaluations()])
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
    assert 0.5 <= sac["improvement_lower"] < 7 / 8 < sac["improvement_upper"] == 1
    assert 100 <= sac["iqm_lower"] < 150 < sac["iqm_upper"] <= 200


@pytest.mark.usefixtures("words_only")
def test_no_interval_from_a_single_seed(tmp_path: Path) -> None:
    runs = {**DISTANCES, "lve": {0: (160, 180)}}
    results = read(tmp_path, final=final(runs))
    table = tables.score_table(results)
    lve = table[(table["method"] == "lve") & (table["measure"] == "distance")].iloc[0]
    assert lve["iqm"] == 170 and lve["improvement"] == 0.75
    assert lve[["iqm_lower", "iqm_upper", "improvement_lower", "improvement_upper"]].isna().all()
    assert np.isfinite(table.loc[table["method"] != "lve", "iqm_lower"]).all()
    text = tables.score_markdown(table, DISTANCE, "have").splitlines()
    assert [part.strip() for part in text[3].split("|")[1:-1]] == ["lve", "1", "170", "0.75"]
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "lve: a single seed, hence no interval" in report and "not known for want of seeds for `lve`" in report


@pytest.mark.usefixtures("words_only")
def test_kept_share_by_hand(tmp_path: Path) -> None:
    # returns 5 -> 1 and 15 -> 6; the healthy return of lve's seed 1 is negative
    kept = {"have": {0: (100.0, 60.0), 1: (200.0, 110.0)}, "lve": {0: (100.0, 60.0), 1: (40.0, 20.0)}}
    results = read(tmp_path, final=final(), failures=failure_rows(kept))
    lve, have = tables.kept_table(results).to_dict("records")
    assert (lve["method"], have["method"], have["modality"], have["kind"]) == ("lve", "have", "rgb", "black")
    assert have["return_kept"] == pytest.approx((0.2 + 0.4) / 2)
    assert (have["return_lowest"], have["return_highest"]) == pytest.approx((0.2, 0.4))
    assert have["distance_kept"] == pytest.approx((0.6 + 0.55) / 2)
    assert (lve["return_kept"], lve["return_seeds"]) == (pytest.approx(0.2), 1)
    assert (lve["distance_kept"], lve["distance_seeds"]) == (pytest.approx((0.6 + 0.5) / 2), 2)
    report = write_report(tmp_path, tmp_path / "out").read_text()
    assert "there is none with the failure: lve (rgb black)." in report


def test_kept_share_is_of_the_same_weathers(tmp_path: Path) -> None:
    rows = failure_rows({"have": {0: (100.0, 60.0)}})
    rows.append({**rows[0], "weather": NOON, **moments(1000, 1)})  # healthy only
    (have,) = tables.kept_table(read(tmp_path, final=final(), failures=rows)).to_dict("records")
    assert have["distance_kept"] == pytest.approx(0.6)


def test_markdown_escapes_and_lines_up() -> None:
    assert tables.markdown(["a|b", "c"], [["1", "long"]]) == "| a\\|b | c    |\n|------|------|\n| 1    | long |"


# Figures


def test_learning_curves_are_means_of_weathers_with_the_range_of_seeds(results: Results) -> None:
    figure = figures.plot_learning_curves(results)
    distance, ret = panel(figure, "distance"), panel(figure, "return")
    assert points(line(distance, "have (2)")) == [(1000, 111.25), (2000, 222.5)]
    assert points(line(distance, "sac (2)")) == [(1000, 75), (2000, 150)]
    assert points(line(ret, "have (2)"))[1][1] == pytest.approx(17.25)
    band = np.asarray(distance.collections[1].get_paths()[0].vertices, float)
    assert {(float(x), float(y)) for x, y in band} == {(1000, 85), (1000, 137.5), (2000, 170), (2000, 275)}
    assert to_hex(line(distance, "have (2)").get_color()) == "#000000"


def test_learning_curves_leave_out_seeds_that_lag_behind(tmp_path: Path) -> None:
    rows = evaluations({"have": {0: (100, 200)}}) + evaluations({"have": {1: (1000, 2000)}}, {1000: 1.0})
    rows += evaluations({"have": {0: (999,)}}, {3000: 1.0})  # not yet in every weather
    figure = figures.plot_learning_curves(read(tmp_path, evaluations=rows))
    assert points(line(panel(figure, "distance"), "have (1)")) == [(1000, 75), (2000, 150)]
    assert not panel(figure, "distance").collections  # a single seed has no band


def test_learning_curves_of_many_methods_share_the_reference(tmp_path: Path) -> None:
    methods = ["have", *(f"method{i}" for i in range(9))]
    rows = evaluations({name: {0: (i, i)} for i, name in enumerate(methods)})
    figure = figures.plot_learning_curves(read(tmp_path, evaluations=rows))
    drawn = [[str(line.get_label()) for line in axis.get_lines()] for axis in figure.axes]
    assert [len(names) for names in drawn] == [8, 8, 3, 3] and all("have (1)" in names for names in drawn)


def test_drivers_are_levels_unless_far_above(tmp_path: Path) -> None:
    drivers = [{"driver": d, "weather": NOON, **moments(x)} for d, x in (("random", 50), ("IDM", 2134))]
    figure = figures.plot_learning_curves(read(tmp_path, evaluations=evaluations(), drivers=drivers))
    axis = panel(figure, "distance")
    assert {y for _, y in points(line(axis, "random"))} == {50}
    assert axis.get_title() == "above: IDM 2134" and axis.get_ylim()[1] < 400


def test_intervals_are_drawn_where_they_are(tmp_path: Path) -> None:
    results = read(tmp_path, final=final({**DISTANCES, "lve": {0: (160, 180)}}))
    table = tables.score_table(results)
    axis = panel(figures.plot_scores(results, table=table), "IQM of distance")
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["sac (2)", "lve (1)", "have (2)"]
    rows = table[table["measure"] == "distance"].set_index("method")
    bounds = [points(drawn) for drawn in axis.get_lines() if len(points(drawn)) == 2]
    assert bounds == [
        [(rows.loc[name, "iqm_lower"], place), (rows.loc[name, "iqm_upper"], place)]
        for name, place in (("sac", 0), ("have", 2))
    ]
    dots = [drawn for drawn in axis.get_lines() if len(points(drawn)) == 1]
    assert [points(dot)[0] for dot in dots] == [(150, 0), (170, 1), (220, 2)]
    assert [to_hex(dot.get_markerfacecolor()) == "#ffffff" for dot in dots] == [False, True, False]


def test_improvement_is_drawn_beside_one_half(results: Results) -> None:
    axis = panel(figures.plot_improvement(results), "in distance")
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["sac (2)"]
    half = [drawn for drawn in axis.get_lines() if drawn.get_linestyle() == "--"]
    assert [points(drawn) for drawn in half] == [[(0.5, 0), (0.5, 1)]]
    assert [points(drawn) for drawn in axis.get_lines() if len(points(drawn)) == 1] == [[(0.875, 0)]]
    with pytest.raises(ValueError, match="'lve'"):
        figures.plot_improvement(results, "lve")


def test_profiles_fall_at_the_scores(results: Results) -> None:
    axis = figures.plot_profiles(results).axes[0]
    drawn = line(axis, "have")
    assert drawn.get_drawstyle() == "steps-post"
    shares = dict(points(drawn))
    assert [shares[x] for x in (0, 140, 150, 190, 200, 250, 300)] == [1, 1, 0.75, 0.5, 0.5, 0.25, 0]


def test_weights_by_weather(tmp_path: Path) -> None:
    rows = weight_rows({0: [0.2, 0.4], 1: [0.5]}) + weight_rows({0: [0.9]}, weather=NOON)
    figure = figures.plot_weather_weights(read(tmp_path, final=final(), weights=rows))
    (axis,) = figure.axes
    assert axis.get_title() == "have, mean of seeds 0, 1"
    # the seeds' means at night are 0.3 and 0.5
    assert bars(axis)["#d55e00"] == pytest.approx([0.9, 0.4]) and bars(axis)["#0072b2"] == pytest.approx([0.1, 0.6])
    np.testing.assert_allclose(whiskers(axis), [[0.9, 0.9], [0.3, 0.5], [0.1, 0.1], [0.5, 0.7]])
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["Clear\nNoon", "Clear\nNight"]


def test_weights_over_an_episode(tmp_path: Path) -> None:
    rows = weight_rows({0: [0.2, 0.4], 1: [0.5]}) + weight_rows({0: [0.9]}, weather=NOON)
    ends = {"return": 8.0, "distance": 70.0, "steps": 2, "crashed": True, "offroad": False}
    episodes = [{"method": "have", "seed": 0, "weather": NIGHT, "episode_seed": 7, **ends}]
    results = read(tmp_path, final=final(), weights=rows, episodes=episodes)
    noon, night = figures.plot_episode_weights(results, "have", 0).axes
    assert (noon.get_title(), night.get_title()) == (NOON, f"{NIGHT}, return 8")
    assert points(line(night, "rgb")) == [(0, 0.2), (1, 0.4)]
    assert points(line(night, "event")) == [(0, 0.8), (1, 0.6)] and points(line(noon, "rgb")) == [(0, 0.9)]
    with pytest.raises(ValueError, match="'lve' with seed 3"):
        figures.plot_episode_weights(results, "lve", 3)


def test_kept_share_bars(tmp_path: Path) -> None:
    rows = failure_rows({"have": {0: (100.0, 60.0), 1: (200.0, 110.0)}, "sac": {0: (60.0, 150.0)}})
    rows += [row for row in failure_rows({"sac": {0: (60.0, 45.0)}}, "event") if row["kind"] == "black"]
    table = tables.kept_table(read(tmp_path, final=final(), failures=rows))
    figure = figures.plot_kept(table, RETURN)
    rgb, event = panel(figure, "rgb fails"), panel(figure, "event fails")
    assert bars(rgb) == {"#888888": [pytest.approx(10)], "#000000": [pytest.approx(0.3)]}
    assert bars(event) == {"#888888": [pytest.approx(-0.5)]}
    np.testing.assert_allclose(whiskers(rgb), [[0.2, 0.4]])
    assert rgb.get_ylim()[1] == figures.KEPT[1] and -1 <= rgb.get_ylim()[0] < -0.5
    assert [tick.get_text() for tick in rgb.get_xticklabels()] == ["black"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["sac", "have"]


def test_methods_look_different_and_always_the_same() -> None:
    looks = [(style.colour, style.line, style.marker, style.hatch) for style in figures.STYLES.values()]
    assert len(set(looks)) == len(looks)
    for other, style in figures.STYLES.items():
        alike = [name for name, look in figures.STYLES.items() if look[:2] == style[:2] and name != other]
        assert not alike, f"{other} is told from {alike} by its marker only"
    assert figures.style("my-method") == figures.style("my-method") != figures.style("have")


def test_letters_are_legible(results: Results) -> None:
    for figure in (figures.plot_learning_curves(results), figures.plot_scores(results), figures.plot_profiles(results)):
        figure.draw_without_rendering()
        sizes = [
            float(text.get_fontsize()) for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()
        ]
        assert len(sizes) > 5 and min(sizes) >= 9


# Half a benchmark


@pytest.mark.usefixtures("words_only")
def test_report_says_what_is_missing(tmp_path: Path) -> None:
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
def test_grid_tells_what_there_is_to_be(tmp_path: Path) -> None:
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
    grid.write_text("methods: 3\n")
    with pytest.raises(ResultsError, match=r"core\.yml is no grid with methods and seeds"):
        write_report(folder)


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
def test_runs_of_different_length_are_told(tmp_path: Path) -> None:
    write(tmp_path / "a", final=final({"sac": DISTANCES["sac"]}))
    write(tmp_path / "b", final=final({"have": DISTANCES["have"]}, step=90_000))
    report = write_report([tmp_path / "a", tmp_path / "b"], tmp_path / "out").read_text()
    assert "**Runs of different length are side by side**: 2,000 and 90,000 steps." in report


# The report


def test_report_and_all_that_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert "best first: `have` 222 m, `sac` 150 m." in report
    assert "| have   | 4        | 0.75    | 0.00          | 30         |" in report
    assert "gamma: 0.9\npolicy_kwargs.features_dim: 50\n" in report and '| sac    | name    | "sac"  |' in report
    assert "- a machine (4 runs)" in report and "- torch 2 (4 runs)" in report


@pytest.mark.usefixtures("words_only")
def test_weathers_that_others_win_are_told(tmp_path: Path) -> None:
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
    seeds = {"have": (30, 50), "rgb": (10, 20), "sac": (40, 41), "lve": (60, 70)}
    runs: Runs = {name: {0: (a, a), 1: (b, b)} for name, (a, b) in seeds.items()}
    report = write_report(write(tmp_path / "a", final=final({**runs, "drq": {0: (1, 1)}}))).read_text()
    told = "above 0.5 for `rgb`; including 0.5 for `sac`; below 0.5 for `lve`; not known for want of seeds for `drq`"
    assert f"Probability that `have` is better in distance, its 95% interval: {told}." in report


def test_settings_by_dotted_names() -> None:
    assert flatten({"a": {"b": 1, "c": {"d": [2]}}, "e": {}}) == {"a.b": 1, "a.c.d": [2], "e": {}}


# Wrong files


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        (
            "final.csv",
            ("sac,1,ClearNight", "sac,x,ClearNight"),
            "final.csv, line 5: seed: expected a whole number, got 'x'",
        ),
        ("final.csv", ("sac,1,ClearNight", "sac,1.5,ClearNight"), "line 5: seed: expected a whole number, got '1.5'"),
        ("final.csv", (",160,", ",inf,"), "line 5: distance_mean: expected a number, got 'inf'"),
        ("final.csv", (",11.0,", ",,"), "line 5: return_mean: expected a number, got ''"),
        ("final.csv", ("sac,1,ClearNight", "sac,1,"), "line 5: weather: expected a name, got ''"),
        ("final.csv", ("sac,1,ClearNight", "sac,1,ClearNight,9"), "line 5: expected 9 fields, got 10"),
        ("final.csv", ("weather", "wheather"), r"line 1: wrong columns \(missing: weather; unknown: wheather\)"),
        ("final.csv", ("seed,weather", "seed,seed,weather"), "line 1: a column is there twice"),
        (
            "final.csv",
            ("sac,1,ClearNight", "sac,0,ClearNight"),
            r"twice, at .*, line 3 and .*, line 5: method sac, seed 0",
        ),
        ("runs.csv", ('"{""gamma""', '"{gamma'), "runs.csv, line 2: settings: expected JSON"),
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
    with pytest.raises(ResultsError, match=r"final\.csv is empty: expected the columns method, seed"):
        read_results([tmp_path])
    path = write(tmp_path, final=final()) / "final.csv"
    path.write_text(path.read_text()[:-12])
    with pytest.raises(ResultsError, match=r"line 9: .* was it cut short\?"):
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
    assert results.methods == results.scored() == ["sac", "have", "a-new-one"] and results.seeds == [0, 1]
    assert results.finished_seeds("a-new-one") == [0]


def test_types_of_what_is_read(tmp_path: Path) -> None:
    ends = {"return": 8, "distance": "", "steps": 20.0, "crashed": True, "offroad": ""}
    rows = [{"method": "have", "seed": 0, "weather": "none", "episode_seed": 4_294_967_295, **ends}]
    frame = read_csv(write(tmp_path, episodes=rows) / "episodes.csv")
    (row,) = frame.to_dict("records")
    assert (row["episode_seed"], row["steps"], row["crashed"], row["weather"]) == (4_294_967_295, 20, 1, "none")
    assert np.isnan(row["distance"]) and np.isnan(row["offroad"])
