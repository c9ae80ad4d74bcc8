"""Figures show what was measured, files are small, and pyplot is left alone."""

import io
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from fake_drive import ENV_ID
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from sb3_have.envs.drivers import KeepStraightDriver
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.plotting import Frames, modality_colours, plot_learning_curve, plot_modality_weights, write_gif
from sb3_have.plotting.episode import images


class Weighing(KeepStraightDriver):
    """A driver that weighs depth by the brightness of the image."""

    def modality_weights(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        depth = observation["depth"].mean(axis=(1, 2, 3)) / 255
        return {"depth": depth, "rgb": 1 - depth}


@pytest.fixture
def recording() -> Recording:
    return record_episode(Weighing(), ENV_ID, "fast", seed=4, render=True)


def pixels(figure: Figure) -> np.ndarray:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return np.asarray(Image.open(buffer).convert("RGB"))


def points(line: Line2D) -> np.ndarray:
    return np.column_stack([np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)])


def test_recording_pairs_observations_with_their_weights(recording: Recording) -> None:
    steps = 8  # seed 4
    assert len(recording.observations) == len(recording.pictures) == len(recording.infos) == steps
    seen = [observation["depth"].mean() / 255 for observation in recording.observations]
    assert seen == pytest.approx((10 * np.arange(steps) + steps) / 255)
    np.testing.assert_allclose(recording.weights["depth"], seen)
    assert [info["distance"] for info in recording.infos] == [2.0 * step for step in range(steps)]
    assert [picture[0, 0, 0] for picture in recording.pictures] == [20 * step for step in range(steps)]
    end = {"distance": 16.0, "speed": 40.0, "crashed": True, "offroad": False, "TimeLimit.truncated": False}
    assert recording.end == end


def test_recording_stops_at_max_steps() -> None:
    short = record_episode(Weighing(), ENV_ID, "fast", seed=4, max_steps=3)
    assert len(short.infos) == 3 and short.end["distance"] == 6.0
    assert record_episode(KeepStraightDriver(), ENV_ID, "fast").weights == {}


def test_learning_curve_shows_steps_and_running_mean() -> None:
    episodes = pd.DataFrame({"l": [10, 20, 30], "distance": [1.0, 3.0, 8.0]})
    axis = plot_learning_curve(episodes, window=2, references={"random": 5.0}).axes[0]
    raw, mean, reference = axis.get_lines()
    np.testing.assert_allclose(points(raw), [[10, 1], [30, 3], [60, 8]])
    np.testing.assert_allclose(points(mean)[:, 1], np.array([1.0, 2.0, 5.5]))
    np.testing.assert_allclose(points(reference)[:, 1], 5.0)
    assert plot_learning_curve(episodes).axes[0].get_xlim()[0] == 0


def test_learning_curve_before_the_first_episode() -> None:
    figure = plot_learning_curve(pd.DataFrame({"l": [], "distance": []}))
    assert [text.get_text() for text in figure.axes[0].texts] == ["no episode ended yet"]


def test_modality_weights_over_the_episode(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_have.plotting.episode.THUMBNAILS", 4)
    figure = plot_modality_weights(recording)
    *thumbnails, curves = figure.axes
    assert len(thumbnails) == 2 * 4
    assert [axis.get_ylabel() for axis in thumbnails[::4]] == ["rgb", "depth"]
    lines = {str(line.get_label()): line for line in curves.get_lines()}
    expected = np.column_stack([recording.times, recording.weights["depth"]])
    np.testing.assert_allclose(points(lines["depth"]), expected)
    # the thumbnails are those of the steps that are marked in the curves
    shown = [int(np.asarray(axis.images[0].get_array())[0, 0, 0]) for axis in thumbnails[:4]]
    (marks,) = curves.collections
    times = [float(np.asarray(path.vertices)[0, 0]) for path in marks.get_paths()]
    np.testing.assert_allclose(times, recording.times[[1, 3, 5, 7]])
    assert shown == [10 * step + 8 for step in (1, 3, 5, 7)]
    assert pixels(figure).std() > 10


def test_weights_are_needed() -> None:
    with pytest.raises(ValueError, match="modality_weights"):
        plot_modality_weights(record_episode(KeepStraightDriver(), ENV_ID, "fast"))


def test_gif_loops_and_its_bars_are_the_weights(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "drive.gif"
    write_gif(recording, path, width=240)
    with Image.open(path) as gif:
        assert gif.n_frames == 8 and gif.info["loop"] == 0 and gif.width == 240  # type: ignore[attr-defined]
        assert gif.info["duration"] == 1000 * (recording.seconds or 0.1)
        colour = np.array([int(modality_colours(["depth"])["depth"][i : i + 2], 16) for i in (1, 3, 5)])
        frames = Frames(recording, 240)
        top = 2 * 18 + frames.tile + 4 + 18  # the second bar, under a line of facts, the names and the images
        for step in range(8):
            gif.seek(step)
            bar = np.abs(np.asarray(gif.convert("RGB")).astype(int) - colour).sum(-1)[top : top + 18] < 60
            expected = recording.weights["depth"][step] * (frames.right - frames.left)
            assert bar.sum(1).max() == pytest.approx(expected, abs=1.5)


def test_gif_keeps_its_size_limit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (60, 120, 3), dtype=np.uint8) for _ in range(40)]
    recording = Recording("fast", 0.2, observations=[{}] * 40, pictures=noise, infos=[{}] * 40)
    write_gif(recording, tmp_path / "noise.gif", width=120, max_bytes=100_000)
    assert (tmp_path / "noise.gif").stat().st_size <= 100_000
    with Image.open(tmp_path / "noise.gif") as gif:
        assert 1 < gif.n_frames < 40  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="empty"):
        write_gif(Recording("fast", 0.2), tmp_path / "none.gif")
    assert [path.name for path in tmp_path.iterdir()] == ["noise.gif"]


def test_images_of_other_sensors_are_scaled() -> None:
    signed = np.zeros((8, 8, 5))
    signed[0, 0, -1], signed[0, 1, -1] = 1.0, -1.0
    event = images({"event": signed})["event"]
    np.testing.assert_array_equal(event[0, :3], [[255] * 3, [0] * 3, [127] * 3])  # grey, without events in the middle
    np.testing.assert_array_equal(images({"event": (127 * signed).astype(np.int8)})["event"], event)
    assert images({"lidar": signed[..., -1:] > 0})["lidar"][0, :2].tolist() == [[255] * 3, [0] * 3]
    grey = np.full((8, 8, 1), 9, np.uint8)
    assert images({"rgb": grey})["rgb"].shape == (8, 8, 3)
    encoded = images({"event": np.full((8, 8, 5), 128, np.uint8)})["event"]
    assert (encoded == 255).all()  # 128 means no event, which is white


def test_pyplot_is_left_alone(recording: Recording) -> None:
    before = plt.get_backend(), plt.get_fignums()
    pixels(plot_modality_weights(recording))
    pixels(plot_learning_curve(pd.DataFrame({"l": [5], "distance": [1.0]})))
    assert (plt.get_backend(), plt.get_fignums()) == before
