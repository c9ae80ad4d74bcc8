"""Untrained drivers: in the episodes of the methods, in a file that a report reads."""

from pathlib import Path

import pytest
import yaml

from benchmarks import drivers
from sb3_have.benchmark.grid import FINAL_SEED, read_grid
from sb3_have.benchmark.reading import read_csv
from sb3_have.envs.drivers import KeepStraightDriver
from sb3_have.evaluation.evaluation import evaluate_episodes


def write_grid(folder: Path, **changes: object) -> Path:
    env_kwargs = {"image_size": 36, "max_episode_steps": 20, "vehicles_count": 3}
    given = {"methods": ["rgb", "gve"], "seeds": [0], "weathers": ["WetNoon", "ClearNight"], "final_episodes": 2}
    path = folder / "small.yml"
    path.write_text(yaml.safe_dump({**given, "hyperparams": {"env_kwargs": env_kwargs}, **changes}))
    return path


def test_drivers_of_a_grid(tmp_path: Path) -> None:
    path, results = write_grid(tmp_path), tmp_path / "results"
    drivers.main([str(path), "--results", str(results)])
    table = read_csv(results / "drivers.csv").set_index(["driver", "weather"])
    assert list(table.index) == [
        (driver, weather)
        for driver in ("random", "straight at 20 m/s", "IDM/MOBIL")
        for weather in ("WetNoon", "ClearNight")
    ]
    assert (table["episodes"] == 2).all()
    # from rest: 5 m/s^2 at full throttle, 3 m/s^2 by IDM
    distance = table["distance_mean"].groupby("driver").mean()
    assert distance["straight at 20 m/s"] > distance["IDM/MOBIL"] > distance["random"] > 0

    config = read_grid(path).jobs()[1].config  # of a method with more sensors
    kwargs = {key: value for key, value in config["env_kwargs"].items() if key != "weather"}
    driver = KeepStraightDriver(20.0)
    episodes = evaluate_episodes(driver, "HighwayVision-v0", ["ClearNight"], 2, FINAL_SEED, kwargs)
    straight = table["return_mean"].to_dict()[("straight at 20 m/s", "ClearNight")]
    assert straight == pytest.approx(episodes["return"].mean(), abs=1e-3)


def test_grid_of_another_environment_is_refused(tmp_path: Path) -> None:
    (tmp_path / "own.yml").write_text("fake_drive:FakeDrive-v0: {policy: MultiInputPolicy}")
    grid = read_grid(write_grid(tmp_path, methods=["own.yml"], env="fake_drive:FakeDrive-v0", hyperparams={}))
    with pytest.raises(ValueError, match="need HighwayVision-v0, and the grid's env is fake_drive:FakeDrive-v0"):
        drivers.drive(grid)
