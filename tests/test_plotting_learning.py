"""Learning curves of several runs, at the steps that they share."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from sb3_have.evaluation.statistics import iqm, stratified_bootstrap
from sb3_have.plotting import Curves, evaluation_curves, monitor_curves, plot_learning_curves

STEPS = np.array([1000, 2000, 3000])
SCORES = np.random.default_rng(0).normal(size=(3, 5, 2)) + 10 * np.arange(3)[:, None, None]


def drawn(figure: Figure) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    (axis,) = figure.axes
    return {
        str(line.get_label()): (np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float))
        for line in axis.get_lines()
    }


def test_a_curve_is_the_statistic_and_its_band_the_bootstrap_interval() -> None:
    curves = {"have": Curves(STEPS, SCORES), "sac": Curves(STEPS, SCORES[:, :1] - 5)}
    figure = plot_learning_curves(curves, label="return", references={"random": 3.0})
    lines = drawn(figure)
    np.testing.assert_array_equal(lines["have (5 runs)"][0], STEPS)
    np.testing.assert_allclose(lines["have (5 runs)"][1], [iqm(table) for table in SCORES])
    np.testing.assert_allclose(lines["sac (1 run)"][1], [iqm(table) for table in SCORES[:, :1] - 5])
    np.testing.assert_allclose(lines["random"][1], 3.0)
    (band,) = figure.axes[0].collections  # a single run has none
    corners = np.asarray(band.get_paths()[0].vertices, float)
    for step, table in zip(STEPS, SCORES, strict=True):
        interval = stratified_bootstrap(iqm, table)
        heights = corners[corners[:, 0] == step, 1]
        np.testing.assert_allclose([heights.min(), heights.max()], [interval.lower, interval.upper])
    assert figure.axes[0].get_ylabel() == "IQM of return" and figure.axes[0].get_xlabel() == "training steps"


def test_text_is_legible() -> None:
    figure = plot_learning_curves({"have": Curves(STEPS, SCORES[:, :1])}, "distance [m]")
    assert figure.axes[0].get_ylabel() == "IQM of distance [m]"
    figure.draw_without_rendering()
    sizes = [float(text.get_fontsize()) for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()]
    assert len(sizes) > 5 and min(sizes) >= 9


def test_curves_differ_by_more_than_their_colour() -> None:
    curves = {str(i): Curves(STEPS, SCORES[:, :1] + i) for i in range(8)}
    lines = plot_learning_curves(curves).axes[0].get_lines()
    assert len({(line.get_linestyle(), line.get_marker()) for line in lines}) == 8


def test_nothing_to_draw() -> None:
    with pytest.raises(ValueError, match="empty"):
        plot_learning_curves({})


def evaluations(method: str, seed: int, steps: list[int], offset: float = 0.0) -> pd.DataFrame:
    rows = [
        {"method": method, "seed": seed, "step": step, "weather": weather, "return_mean": step / 1000 + offset + i}
        for step in steps
        for i, weather in enumerate(("noon", "night"))
    ]
    return pd.DataFrame(rows)


def test_evaluations_of_a_benchmark() -> None:
    parts = [
        evaluations("have", 0, [1000, 2000]),
        evaluations("have", 1, [2000, 1000], 0.5),
        evaluations("sac", 0, [1000]),
    ]
    curves = evaluation_curves(pd.concat(parts))
    assert list(curves) == ["have", "sac"]
    np.testing.assert_array_equal(curves["have"].steps, [1000, 2000])
    # steps, seeds, weathers in alphabetical order: night is one more than noon
    expected = [[[2.0, 1.0], [2.5, 1.5]], [[3.0, 2.0], [3.5, 2.5]]]
    np.testing.assert_allclose(curves["have"].scores, expected)
    assert curves["sac"].scores.shape == (1, 1, 2)


def test_runs_that_lag_behind_and_half_evaluations_do_not_count() -> None:
    late, half = evaluations("have", 1, [1000]), evaluations("have", 0, [3000]).iloc[:1]
    (curve,) = evaluation_curves(pd.concat([evaluations("have", 0, [1000, 2000]), late, half])).values()
    np.testing.assert_array_equal(curve.steps, [1000, 2000])
    assert curve.scores.shape == (2, 1, 2)


def test_a_method_that_is_left_out_is_named_in_a_warning() -> None:
    parts = [evaluations("have", 0, [1000, 2000]), evaluations("sac", 0, [1000, 2000]).query("weather == 'noon'")]
    with pytest.warns(UserWarning, match="'sac' has no evaluation in all 2 weathers"):
        assert list(evaluation_curves(pd.concat(parts))) == ["have"]


def test_runs_without_a_method_and_doubled_rows() -> None:
    rows = evaluations("have", 0, [1000]).drop(columns="method")
    assert list(evaluation_curves(rows)) == [""]
    with pytest.raises(ValueError, match="several rows"):
        evaluation_curves(pd.concat([rows, rows]))


def monitor(folder: Path, lengths: list[int], returns: list[float], name: str = "monitor.csv", start: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    rows = [f"{r},{n},{start + i}" for i, (n, r) in enumerate(zip(lengths, returns, strict=True))]
    (folder / name).write_text('#{"t_start": 0.0, "env_id": "None"}\nr,l,t\n' + "\n".join(rows) + "\n")
    return folder


def test_monitor_files_on_common_steps(tmp_path: Path) -> None:
    one = monitor(tmp_path / "0", [10, 10, 20], [1.0, 3.0, 8.0])
    two = monitor(tmp_path / "1", [20, 10], [2.0, 6.0])
    steps, scores = monitor_curves([one, two], window=2, points=3)
    np.testing.assert_allclose(steps, [20, 25, 30])  # from the first episode of both to the end of the shorter run
    np.testing.assert_allclose(scores[:, 0, 0], [2.0, 2.0, 2.0])
    np.testing.assert_allclose(scores[:, 1, 0], [2.0, 2.0, 4.0])


def test_monitor_files_of_several_environments(tmp_path: Path) -> None:
    monitor(tmp_path / "0", [10, 10], [1.0, 5.0], "0.monitor.csv")
    monitor(tmp_path / "0", [10], [3.0], "1.monitor.csv", start=5)
    steps, scores = monitor_curves([tmp_path / "0"], window=1, points=3)
    np.testing.assert_allclose(steps, [10, 20, 30])
    np.testing.assert_allclose(scores[:, 0, 0], [1.0, 5.0, 3.0])


def test_monitor_files_without_common_steps(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no episode"):
        monitor_curves([monitor(tmp_path / "0", [], [])])
    runs = [monitor(tmp_path / "1", [10], [1.0]), monitor(tmp_path / "2", [30], [1.0])]
    with pytest.raises(ValueError, match=r"step 10, before .* at 30"):
        monitor_curves(runs)
