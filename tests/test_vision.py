"""The three sensors together: spaces, determinism, options, and what each weather leaves to see."""

import importlib.util
import pickle
from itertools import chain, combinations
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.envs.vision import MODALITIES, VisionSensors, compose
from sb3_have.envs.weather import WEATHERS, rain_events, weather_by_name
from sb3_have.sensors import Representation, decode_depth, decode_events

Array = NDArray[Any]
SUBSETS = list(chain.from_iterable(combinations(MODALITIES, n) for n in (1, 2, 3)))


def traffic(count: int = 6) -> tuple[Array, Array]:
    poses = np.zeros((1 + count, 3))
    poses[:, 0] = 50 + 9.0 * np.arange(1 + count)
    poses[:, 1] = 4.0 * (np.arange(1 + count) % 4)
    return poses, np.tile((5.0, 2.0), (1 + count, 1))


def drive(poses: Array, speed: float, instants: int = 5, duration: float = 0.2) -> Array:
    """The ego moves past standing traffic, (instants, vehicles, 3)."""
    moved = np.repeat(poses[None], instants, axis=0)
    moved[:, 0, 0] += speed * np.linspace(0, duration, instants)
    return moved


def episode(sensors: VisionSensors, weather: str, steps: int = 3, seed: int = 0, speed: float = 20.0) -> list[Any]:
    rng = np.random.default_rng(seed)
    poses, sizes = traffic()
    observations = [sensors.reset(weather, poses, sizes, rng)]
    for _ in range(steps):
        instants = drive(poses, speed)
        observations.append(sensors.observe(instants, 0.2, rng))
        poses = instants[-1]
    return observations


@pytest.mark.parametrize("weather", WEATHERS)
@pytest.mark.parametrize("modalities", SUBSETS, ids="+".join)
def test_observations_lie_in_their_spaces(weather: str, modalities: tuple[str, ...]) -> None:
    sensors = VisionSensors(32, modalities)
    assert tuple(sensors.spaces) == modalities
    for observation in episode(sensors, weather):
        assert tuple(observation) == modalities
        assert all(sensors.spaces[name].contains(image) for name, image in observation.items())
        assert "event" not in observation or observation["event"].min() > 0


def test_the_first_event_image_is_empty() -> None:
    for weather in WEATHERS:
        assert (episode(VisionSensors(32), weather, steps=0)[0]["event"] == 128).all()


@pytest.mark.parametrize("weather", ["ClearNoon", "HardRainNight"])
def test_same_generator_same_bits(weather: str) -> None:
    sensors = VisionSensors(32, event={"shot_rate": 1.0})
    first, again = episode(sensors, weather), episode(sensors, weather)
    fresh = episode(pickle.loads(pickle.dumps(sensors)), weather)
    other = episode(sensors, weather, seed=1)
    for name in MODALITIES:
        for a, b, c in zip(first, again, fresh, strict=True):
            np.testing.assert_array_equal(a[name], b[name])
            np.testing.assert_array_equal(a[name], c[name])
    assert (first[-1]["rgb"] != other[-1]["rgb"]).any()


def test_a_standing_scene_makes_no_events_but_rain_does() -> None:
    for weather in WEATHERS:
        for observation in episode(VisionSensors(32), weather, speed=0.0)[1:]:
            silent = bool((observation["event"] == 128).all())
            assert silent != weather.startswith("HardRain")


def test_hard_rain_disturbs_events_and_hardly_the_colour_image() -> None:
    for time in ("Noon", "Night"):
        dry, wet = (episode(VisionSensors(48), weather + time, 6, speed=0.0)[1:] for weather in ("Clear", "HardRain"))
        noise = {
            name: np.mean([np.abs(decode_events(observation["event"])).sum(axis=-1) for observation in part])
            for name, part in (("dry", dry), ("wet", wet))
        }
        colour = {
            name: np.std([observation["rgb"] for observation in part], axis=0).mean()
            for name, part in (("dry", dry), ("wet", wet))
        }
        assert noise["dry"] == 0 and noise["wet"] > 0.1  # events per pixel and step, out of thin air
        assert colour["wet"] < 2 * colour["dry"] and colour["wet"] < 4  # 8-bit steps


def test_rain_events_lie_in_their_window_and_image() -> None:
    rng = np.random.default_rng(0)
    pixel, time, polarity = rain_events(weather_by_name("HardRainNoon"), 1.0, 3.0, 48, 48, rng)
    assert len(pixel) == len(time) == len(polarity) == pytest.approx(1.5 * 2 * 48 * 48, rel=0.05)
    assert pixel.min() >= 0 and pixel.max() < 48 * 48 and time.min() >= 1.0 and time.max() <= 3.0
    assert set(polarity) == {-1.0, 1.0} and (polarity > 0).mean() == pytest.approx(0.65, abs=0.04)
    assert len(rain_events(weather_by_name("WetNoon"), 1.0, 3.0, 48, 48, rng)[0]) == 0


def test_depth_of_a_car_ahead_survives_its_code() -> None:
    poses, sizes = np.array([(0.0, 4.0, 0.0), (34.0, 4.0, 0.0)]), np.tile((5.0, 2.0), (2, 1))
    for encoding in ("log", "clipped", "inverse"):
        limit = {} if encoding == "log" else {"max": 80.0}
        sensors = VisionSensors(64, ("depth",), depth={"encoding": encoding, **limit})
        code = sensors.reset("ClearNoon", poses, sizes, np.random.default_rng(0))["depth"]
        metres = decode_depth(code, encoding, 80.0)[sensors.last_truth["vehicle"] == 0]
        np.testing.assert_allclose(metres, 30.5, rtol=0.06)
        assert (code[:30, 32] == 0).all()  # the sky


@pytest.mark.parametrize("weather", ["WetNight", "HardRainNoon"])
@pytest.mark.parametrize("name", MODALITIES)
def test_a_sensor_does_not_depend_on_the_others(name: str, weather: str) -> None:
    alone, together = VisionSensors(48, (name,)), VisionSensors(48)
    for a, b in zip(episode(alone, weather, 6), episode(together, weather, 6), strict=True):
        np.testing.assert_array_equal(a[name], b[name])
    for truth, image in alone.last_truth.items():
        np.testing.assert_array_equal(image, together.last_truth[truth])


def test_poses_are_interpolated() -> None:
    poses, sizes = traffic()
    images = []
    for instants in (2, 5, 11):
        sensors, rng = VisionSensors(48, ("event",)), np.random.default_rng(0)
        sensors.reset("ClearNoon", poses, sizes, rng)
        images.append(sensors.observe(drive(poses, 25.0, instants), 0.2, rng)["event"])
    assert (images[0] != 128).mean() > 0.02
    assert all((image == images[0]).mean() > 0.999 for image in images[1:])


def test_event_options_reach_the_camera() -> None:
    def activity(**event: Any) -> float:
        images = [
            observation["event"] for observation in episode(VisionSensors(48, ("event",), event=event), "ClearNoon")
        ]
        return float(np.mean([np.abs(decode_events(image)).sum(axis=-1).mean() for image in images]))

    default = activity()
    assert activity(threshold=0.4) < 0.8 * default
    assert activity(refractory=0.15) < 0.8 * default
    assert activity(shot_rate=5.0) > default + 0.3
    assert activity(leak_rate=5.0) > default + 0.3
    assert activity(representation="count", bins=1) > activity(bins=1)  # no signs that cancel
    # Above 20 the logarithm of a digital number moves less than the number itself.
    assert 0 < activity(mapping="lin_log", threshold=0.5) < activity(mapping="identity", threshold=0.5)
    assert VisionSensors(48, event={"bins": 3, "subframes": 4}).spaces["event"].shape == (48, 48, 3)


@pytest.mark.parametrize("representation", get_args(Representation))
def test_every_representation_in_its_space(representation: Representation) -> None:
    sensors = VisionSensors(32, ("event",), event={"representation": representation, "bins": 3})
    images = [observation["event"] for observation in episode(sensors, "ClearNoon")]
    shape = (32, 32, {"polarity": 6, "time_surface": 2}.get(representation, 3))
    assert sensors.spaces["event"].shape == shape and all(sensors.spaces["event"].contains(image) for image in images)
    assert (images[0] == 128).all() and (images[-1] != 128).any()
    assert (images[-1].min() < 128) == (representation in ("sbt", "voxel"))


def test_representations_agree() -> None:
    """The same events in different forms: polarities apart and together, and how recent the last one is."""
    image = {}
    for kind in get_args(Representation):
        sensors = VisionSensors(48, ("event",), event={"representation": kind, "bins": 2})
        image[kind] = episode(sensors, "ClearNoon")[-1]["event"]
    apart = decode_events(image["polarity"])
    np.testing.assert_array_equal(apart[..., :2] - apart[..., 2:], decode_events(image["sbt"]))
    np.testing.assert_array_equal(apart[..., :2] + apart[..., 2:], decode_events(image["count"]))
    surface = decode_events(image["time_surface"], "time_surface")
    some = np.stack((apart[..., :2].sum(axis=-1), apart[..., 2:].sum(axis=-1)), axis=-1) > 0
    np.testing.assert_array_equal(surface > 0, some)
    assert some.any() and surface[some].min() >= np.exp(-1) - 0.005  # tau is one control step
    late = np.stack((apart[..., 1], apart[..., 3]), axis=-1) > 0
    assert surface[late].min() >= np.exp(-0.5) - 0.005 >= surface[some & ~late].max() - 0.01
    short = VisionSensors(48, ("event",), event={"representation": "time_surface", "tau": 0.05})
    assert decode_events(episode(short, "ClearNoon")[-1]["event"], "time_surface")[some].min() < 0.2


def test_bandwidth_reaches_the_camera() -> None:
    def activity(**event: Any) -> float:
        images = [o["event"] for o in episode(VisionSensors(48, ("event",), event=event), "ClearNoon")]
        return float(np.mean([np.abs(decode_events(image)).mean() for image in images]))

    assert activity(cutoff_hz=1e6) == pytest.approx(activity(), rel=1e-3)
    assert activity(cutoff_hz=0.5) < 0.7 * activity()


def test_night_leaves_events_and_takes_contrast() -> None:
    path = Path(__file__).parent.parent / "benchmarks" / "weather_contrast.py"
    spec = importlib.util.spec_from_file_location("weather_contrast", path)
    assert spec is not None and spec.loader is not None
    weather_contrast = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(weather_contrast)
    rows = {row["weather"]: row for row in weather_contrast.run(episodes=6, steps=6, image_size=64)}
    assert tuple(rows) == WEATHERS
    for weather, row in rows.items():
        assert row["saturated"] < 0.1
        assert row["recognised"] > 0.9
        if weather.endswith("Night"):
            assert row["rgb_vs_noon"] < 0.25
            assert row["events_vs_noon"] > 0.6


def test_compose_shows_the_modalities_side_by_side() -> None:
    observation = episode(VisionSensors(32), "ClearNoon")[-1]
    picture = compose(observation, scale=3)
    assert picture.shape == (96, 288, 3) and picture.dtype == np.uint8
    np.testing.assert_array_equal(picture[::3, :96:3], observation["rgb"])
    quiet = (observation["event"] == 128).all(axis=-1)
    assert (picture[::3, 96:192:3][quiet] == 255).all()
    assert (picture[::3, 192::3][observation["depth"][..., 0] == 0] == 0).all()
    for kind in ("polarity", "time_surface"):
        # A positive event now and an older negative one.
        events = np.full((32, 32, 2), 128, dtype=np.uint8)
        events[0, 0, 0], events[0, 1, 1] = 255, 255
        colours = compose({"event": events}, scale=1, representation=kind)
        assert colours[0, 0, 0] > colours[0, 0, 2] and colours[0, 1, 0] < colours[0, 1, 2]
        assert (colours[1:] == 255).all()
    assert compose({"depth": observation["depth"]}, scale=1).shape == (32, 32, 3)
    with pytest.raises(ValueError, match="lidar"):
        compose({"lidar": observation["depth"]})


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"modalities": ()}, "non-empty subset"),
        ({"modalities": ("rgb", "lidar")}, "lidar"),
        ({"modalities": "rgb"}, "non-empty subset"),
        ({"image_size": 8}, "image_size.*>= 16"),
        ({"image_size": 40.5}, "image_size.*whole number.*40.5"),
        ({"event": {"treshold": 0.1}}, r"\['treshold'\].*threshold"),
        ({"event": {"representation": "image"}}, "voxel"),
        ({"event": {"subframes": 0}}, "subframes"),
        ({"event": {"tau": 0.1}}, "tau.*time_surface.*'sbt'"),
        ({"event": {"representation": "time_surface", "tau": -1.0}}, "tau.*-1"),
        ({"event": {"cutoff_hz": 0.0}}, "cutoff_hz"),
        ({"event": {"subframes": 4.5}}, "subframes.*whole number.*4.5"),
        ({"event": {"bins": 2.7}}, "bins.*whole number.*2.7"),
        ({"depth": {"maximum": 10}}, r"\['maximum'\].*max"),
        ({"depth": {"encoding": "linear"}}, "inverse"),
        ({"depth": {"encoding": "clipped", "max": None}}, "maximum depth must be finite.*None"),
        ({"depth": {"max": 50}}, "max=50 has no effect.*log"),
    ],
)
def test_bad_options(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VisionSensors(**kwargs)


def test_bad_calls() -> None:
    sensors, rng = VisionSensors(32), np.random.default_rng(0)
    poses, sizes = traffic()
    with pytest.raises(ValueError, match="ClearNoon"):
        sensors.reset("Sunny", poses, sizes, rng)
    sensors.reset("ClearNoon", poses, sizes, rng)
    with pytest.raises(ValueError, match=r"\(\.\.\., 7, 3\)"):
        sensors.observe(drive(poses, 1.0)[:, :3], 0.2, rng)
