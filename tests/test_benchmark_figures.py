"""Figures of a benchmark: they show what the runs wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmark_results import (
    DISTANCES,
    NIGHT,
    NOON,
    evaluations,
    failure_rows,
    final,
    moments,
    read,
    run_rows,
    weight_rows,
)
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from sb3_have.benchmark import figures, tables
from sb3_have.benchmark.reading import DISTANCE, RETURN, Results


@pytest.fixture
def results(tmp_path: Path) -> Results:
    return read(tmp_path / "core", final=final(), evaluations=evaluations(), runs=run_rows())


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


def test_learning_curves_are_means_of_weathers_with_the_range_of_seeds(results: Results) -> None:
    figure = figures.plot_progress(results)
    distance, ret = panel(figure, "distance"), panel(figure, "return")
    assert points(line(distance, "have (2)")) == [(1000, 111.25), (2000, 222.5)]
    assert points(line(distance, "sac (2)")) == [(1000, 75), (2000, 150)]
    assert points(line(ret, "have (2)"))[1][1] == pytest.approx(17.25)
    (bands,) = distance.collections  # only the reference has a band
    band = np.asarray(bands.get_paths()[0].vertices, float)
    assert {(float(x), float(y)) for x, y in band} == {(1000, 85), (1000, 137.5), (2000, 170), (2000, 275)}
    assert to_hex(line(distance, "have (2)").get_color()) == "#000000"


def test_learning_curves_leave_out_seeds_that_lag_behind(tmp_path: Path) -> None:
    rows = evaluations({"have": {0: (100, 200)}}) + evaluations({"have": {1: (1000, 2000)}}, {1000: 1.0})
    rows += evaluations({"have": {0: (999,)}}, {3000: 1.0})  # not in every weather yet
    figure = figures.plot_progress(read(tmp_path, evaluations=rows))
    assert points(line(panel(figure, "distance"), "have (1)")) == [(1000, 75), (2000, 150)]
    assert not panel(figure, "distance").collections  # a single seed has no band


def test_learning_curves_of_many_methods_share_the_reference(tmp_path: Path) -> None:
    methods = ["have", *(f"method{i}" for i in range(9))]
    rows = evaluations({name: {0: (i, i)} for i, name in enumerate(methods)})
    figure = figures.plot_progress(read(tmp_path, evaluations=rows))
    drawn = [[str(line.get_label()) for line in axis.get_lines()] for axis in figure.axes]
    assert [len(names) for names in drawn] == [8, 8, 3, 3] and all("have (1)" in names for names in drawn)
    (bottom, top), *_ = [axis.get_ylim() for axis in figure.axes if "distance" in axis.get_ylabel()]
    assert bottom == 0 and top > 9, "the panels of the second row share the axis"


def test_drivers_are_levels_unless_far_above(tmp_path: Path) -> None:
    drivers = [{"driver": d, "weather": NOON, **moments(x)} for d, x in (("random", 50), ("IDM", 2134))]
    figure = figures.plot_progress(read(tmp_path, evaluations=evaluations(), drivers=drivers))
    axis = panel(figure, "distance")
    assert {y for _, y in points(line(axis, "random"))} == {50}
    assert axis.get_title() == "above: IDM 2134" and axis.get_ylim()[1] < 400
    drivers[0] |= moments(350)  # slightly above the curves
    figure = figures.plot_progress(read(tmp_path, evaluations=evaluations(), drivers=drivers[:1]))
    assert panel(figure, "distance").get_ylim()[1] > 350


def test_intervals_are_drawn_where_they_are(tmp_path: Path) -> None:
    runs = {name: {**seeds, 2: (150, 200)} for name, seeds in DISTANCES.items()}
    results = read(tmp_path, final=final({**runs, "lve": {0: (160, 180), 1: (160, 180)}}))
    table = tables.score_table(results)
    axis = panel(figures.plot_scores(results, table=table), "IQM of distance")
    assert [tick.get_text() for tick in axis.get_yticklabels()] == ["sac (3)", "lve (2)", "have (3)"]
    rows = table[table["measure"] == "distance"].set_index("method")
    bounds = [points(drawn) for drawn in axis.get_lines() if len(points(drawn)) == 2]
    assert bounds == [
        [(rows.loc[name, "iqm_lower"], place), (rows.loc[name, "iqm_upper"], place)]
        for name, place in (("sac", 0), ("have", 2))
    ]
    dots = [drawn for drawn in axis.get_lines() if len(points(drawn)) == 1]
    assert [points(dot)[0] for dot in dots] == [(rows.loc[m, "iqm"], i) for i, m in enumerate(("sac", "lve", "have"))]
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
    assert drawn.get_marker() == "o" and line(axis, "sac").get_marker() == "D", "distinguishable without colours"
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
    assert line(night, "event").get_linestyle() != line(night, "rgb").get_linestyle()
    with pytest.raises(ValueError, match="'lve' with seed 3"):
        figures.plot_episode_weights(results, "lve", 3)


def test_failure_bars(tmp_path: Path) -> None:
    rows = failure_rows({"have": {0: (100.0, 60.0), 1: (200.0, 110.0)}, "sac": {0: (60.0, 150.0)}})
    rows += [row for row in failure_rows({"sac": {0: (60.0, 45.0)}}, "event") if row["kind"] == "black"]
    table = tables.failure_table(read(tmp_path, final=final(), failures=rows))
    figure = figures.plot_failures(table, RETURN)
    rgb, event = panel(figure, "rgb fails"), panel(figure, "event fails")
    assert bars(rgb) == {"#888888": [1, 10], "#000000": [10, 3.5]}
    assert bars(event) == {"#888888": [1, -0.5]}, "have has no event failure"
    np.testing.assert_allclose(whiskers(rgb), [[5, 15], [1, 6]])
    assert [tick.get_text() for tick in rgb.get_xticklabels()] == ["none", "rgb black"]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["sac", "have"]


def test_failure_bars_stand_over_their_kind(tmp_path: Path) -> None:
    black = failure_rows({"have": {0: (100.0, 60.0)}, "sac": {0: (100.0, 70.0)}})
    noise = [row | moments(row["distance_mean"] - 30, 1) | {"kind": "noise"} for row in black if row["kind"] == "black"]
    table = tables.failure_table(read(tmp_path, final=final(), failures=[*black, *noise]))
    (axis,) = figures.plot_failures(table, DISTANCE).axes
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["none", "rgb black", "rgb noise"]
    sac, have = (group.patches for group in axis.containers if isinstance(group, BarContainer))
    drawn = [(bar.get_x() + bar.get_width() / 2, bar.get_y(), bar.get_height()) for bar in [*sac, *have]]
    expected = [(-0.21, 0, 100), (0.79, 0, 70), (1.79, 0, 40), (0.21, 0, 100), (1.21, 0, 60), (2.21, 0, 30)]
    np.testing.assert_allclose(drawn, expected)
    assert sac[0].get_hatch() and not have[0].get_hatch()


def test_methods_look_different_and_always_the_same() -> None:
    looks = [(style.colour, style.line, style.marker, style.hatch) for style in figures.STYLES.values()]
    assert len(set(looks)) == len(looks)
    for other, style in figures.STYLES.items():
        alike = [name for name, look in figures.STYLES.items() if look[:2] == style[:2] and name != other]
        assert not alike, f"{other} differs from {alike} in its marker only"
    core = [figures.STYLES[name] for name in ("rgb", "event", "sac", "deepmdp", "gve-wide", "lve")]
    assert len({style.marker for style in core}) == len({style.hatch for style in core}) == len(core), "without colour"
    assert figures.style("my-method") == figures.style("my-method") != figures.style("have")


def test_letters_are_legible(results: Results) -> None:
    for figure in (figures.plot_progress(results), figures.plot_scores(results), figures.plot_profiles(results)):
        figure.draw_without_rendering()
        sizes = [
            float(text.get_fontsize()) for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()
        ]
        assert len(sizes) > 5 and min(sizes) >= 9
