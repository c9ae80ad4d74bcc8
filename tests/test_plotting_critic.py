"""Figures of the critic: its parts over an episode, the weights by weather, the slopes of re-fusion."""

import numpy as np
import pandas as pd
import pytest
from envs import RandomSensors, tiny_model, vectors_space
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.container import BarContainer
from matplotlib.contour import ContourSet

from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.plotting import (
    modality_colours,
    modality_styles,
    plot_decomposition,
    plot_modality_weights,
    plot_refusion,
    plot_weather_weights,
    refusion_response,
    weights_table,
)

T = 4
WEIGHTS = {
    "depth": np.array([0.9, 0.8, 0.7, 0.6]),
    "rgb": np.array([0.1, 0.2, 0.3, 0.4]),
}  # not the order of the figures
VALUES = {
    "q": np.array([[1.0, 5.0, 3.0, 0.0], [2.0, 4.0, 3.5, -1.0]]),
    "q_global": np.arange(8.0).reshape(2, T),
    "q_lve": 10 + np.arange(8.0).reshape(2, T),
    "q_local": 100 + np.arange(16.0).reshape(2, 2, T),
}
TWINS = [0, 1, 0, 1]  # the twin with the lower q
NOW = np.arange(T)


def a_recording(**parts: object) -> Recording:
    defaults: dict[str, object] = {"weights": WEIGHTS, "values": VALUES, "rewards": np.array([1.0, 0.0, 2.0, 4.0])}
    observations = [{"state": np.zeros(3)}] * T
    return Recording("fast", 0.5, observations, infos=[{}] * T, **{**defaults, **parts})  # type: ignore[arg-type]


def lines(axis: Axes) -> dict[str, np.ndarray]:
    drawn = {str(line.get_label()): np.asarray(line.get_ydata(), float) for line in axis.get_lines()}
    times = [np.asarray(line.get_xdata(), float) for line in axis.get_lines()]
    assert all(np.array_equal(x, [0.0, 0.5, 1.0, 1.5]) for x in times)
    return drawn


def test_decomposition_shows_the_lower_twin() -> None:
    top, weights, reward = plot_decomposition(a_recording(), gamma=0.5).axes
    drawn = lines(top)
    np.testing.assert_allclose(drawn["H, re-fusion of both"], [1, 4, 3, -1])
    np.testing.assert_allclose(drawn["global"], VALUES["q_global"][TWINS, NOW])
    np.testing.assert_allclose(drawn["weighted local"], VALUES["q_lve"][TWINS, NOW])
    np.testing.assert_allclose(drawn["local: rgb"], VALUES["q_local"][TWINS, 1, NOW])
    np.testing.assert_allclose(drawn["local: depth"], VALUES["q_local"][TWINS, 0, NOW])
    np.testing.assert_allclose(drawn["discounted return"], [2.0, 2.0, 4.0, 4.0])
    np.testing.assert_allclose(lines(weights)["depth"], WEIGHTS["depth"])
    np.testing.assert_allclose(lines(reward)["reward"], [1, 0, 2, 4])
    assert reward.get_xlabel() == "time [s]"
    colours = {str(line.get_label()): to_hex(line.get_color()) for line in top.get_lines()}
    assert colours["local: depth"] == modality_colours(["depth"])["depth"].lower()


def test_decomposition_without_refusion() -> None:
    parts = {"q": VALUES["q"], "q_global": VALUES["q"]}
    alone, reward = plot_decomposition(a_recording(weights={}, values=parts)).axes
    assert list(lines(alone)) == ["global"] and reward.get_ylabel() == "reward"
    with pytest.raises(ValueError, match="no values"):
        plot_decomposition(a_recording(values={}))


def test_a_recorded_episode_of_vectors_can_be_drawn() -> None:
    recording = record_episode(tiny_model(vectors_space()), RandomSensors(vectors_space(), 5))
    assert len(plot_decomposition(recording).axes) == 3
    (curves,) = plot_modality_weights(recording).axes  # no images, no thumbnails
    assert [str(line.get_label()) for line in curves.get_lines()] == ["a", "b"] and curves.get_xlabel() == "step"


def test_modalities_look_different_without_colours() -> None:
    assert modality_styles(["b", "a"]) == modality_styles(["a", "b"])
    styles = modality_styles(["depth", "state", "rgb", "event"])
    assert list(styles) == ["rgb", "event", "depth", "state"]
    for part in ("colour", "line", "hatch"):
        assert len({getattr(look, part) for look in styles.values()}) == 4


def test_weights_by_weather_are_the_means_of_its_episodes() -> None:
    night = Recording("ClearNight", 0.5, weights={"rgb": np.array([0.2, 0.4]), "depth": np.array([0.8, 0.6])})
    again = Recording("ClearNight", 0.5, weights={"rgb": np.array([0.6]), "depth": np.array([0.4])})
    noon = Recording("WetNoon", 0.5, weights={"rgb": np.array([0.5]), "depth": np.array([0.5])})
    table = weights_table([night, again, noon])
    assert len(table) == 8 and set(table.loc[table["weather"] == "ClearNight", "episode"]) == {0, 1}
    (axis,) = plot_weather_weights(table).axes
    bars = [group.patches for group in axis.containers if isinstance(group, BarContainer)]
    heights = {to_hex(group[0].get_facecolor()): [bar.get_height() for bar in group] for group in bars}
    assert heights["#d55e00"] == pytest.approx([0.4, 0.5]) and heights["#009e73"] == pytest.approx([0.6, 0.5])
    assert [tick.get_text() for tick in axis.get_xticklabels()] == ["Clear\nNight", "Wet\nNoon"]
    assert bars[1][0].get_hatch() and not bars[0][0].get_hatch()
    (reversed_axis,) = plot_weather_weights(table, weathers=["WetNoon", "ClearNight"]).axes
    assert reversed_axis.get_xticklabels()[0].get_text() == "Wet\nNoon"
    with pytest.raises(ValueError, match="empty"):
        plot_weather_weights(weights_table([]))


def test_methods_of_other_modalities_share_a_legend() -> None:
    rows = [
        {"method": method, "weather": "ClearNoon", "modality": name, "weight": 1 / len(names)}
        for method, names in (("have", ("rgb", "state")), ("lve", ("depth", "rgb", "event")))
        for name in names
    ]
    figure = plot_weather_weights(pd.DataFrame(rows))
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["rgb", "event", "depth", "state", "equal weights"]
    handles = dict(zip(("rgb", "event", "depth", "state"), legend.legend_handles, strict=False))
    assert to_hex(handles["depth"].get_facecolor()) == modality_colours(["depth"])["depth"].lower()  # type: ignore[union-attr]
    levels = [float(np.asarray(axis.get_lines()[0].get_ydata())[0]) for axis in figure.axes]
    assert levels == pytest.approx([1 / 2, 1 / 3])


def test_convex_refusion_has_constant_slopes_that_sum_to_one() -> None:
    model = tiny_model(vectors_space())
    observation = vectors_space().sample()
    response = refusion_response(model, observation)
    assert response.h.shape == response.slope_global.shape == (61, 61)
    np.testing.assert_allclose(response.slope_global + response.slope_lve, 1, rtol=1e-5)
    by_hand = response.slope_global[0, 0] * response.q_global + response.slope_lve[0, 0] * response.q_lve[:, None]
    np.testing.assert_allclose(response.h, by_hand, rtol=1e-4, atol=1e-4)
    assert response.q_global.mean() == pytest.approx(response.actual[0], abs=1e-4)


@pytest.mark.parametrize("refusion", ["convex", "monotone", "free"])
def test_slopes_are_those_of_the_surface(refusion: str) -> None:
    model = tiny_model(vectors_space(), refusion=refusion)
    grid = np.linspace(-30, 30, 241)
    response = refusion_response(model, vectors_space().sample(), grid, grid[::3])
    differences = np.diff(response.h, axis=1) / np.diff(grid)
    middle = (response.slope_global[:, 1:] + response.slope_global[:, :-1]) / 2
    smooth = response.slope_global[:, 1:] == response.slope_global[:, :-1]  # not across a kink
    assert smooth.mean() > 0.5
    np.testing.assert_allclose(differences[smooth], middle[smooth], atol=2e-3)
    if refusion != "free":
        assert (response.slope_global > 0).all() and (response.slope_lve > 0).all()


def test_the_sign_of_the_slopes_is_seen() -> None:
    model = tiny_model(vectors_space())
    response = refusion_response(model, vectors_space().sample())
    falling = response._replace(
        slope_lve=np.where(response.q_lve[:, None] > response.actual[1], -0.5, 0.25) + 0 * response.h
    )
    for given, hatched in ((response, False), (falling, True)):
        figure = plot_refusion(given)
        surface, left, right = figure.axes[:3]
        assert not any(getattr(part, "hatches", None) for part in left.collections)
        assert any(getattr(part, "hatches", None) for part in right.collections) is hatched
        assert surface.get_xlabel() == "global value $q_g$" and "q_l" in surface.get_ylabel()
        filled, drawn = (set(part.levels) for part in surface.collections if isinstance(part, ContourSet))
        assert len(drawn) >= 4 and drawn < filled
    share = 100 * (falling.slope_lve < 0).mean()
    assert right.get_title().endswith(f"-0.50 to 0.25, negative on {share:.0f} %")
    mesh = np.asarray(right.collections[0].get_array(), float)
    np.testing.assert_allclose(mesh.reshape(61, 61), falling.slope_lve)
    (dot,) = right.get_lines()
    assert (dot.get_xdata()[0], dot.get_ydata()[0]) == response.actual  # type: ignore[index]


def test_without_refusion_there_is_no_response() -> None:
    with pytest.raises(ValueError, match="'lve' has no re-fusion"):
        refusion_response(tiny_model(vectors_space(), value_estimation="lve"), vectors_space().sample())
    batch = {key: np.stack([value, value]) for key, value in vectors_space().sample().items()}
    with pytest.raises(ValueError, match="batch of 2"):
        refusion_response(tiny_model(vectors_space()), batch)
