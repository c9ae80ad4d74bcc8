"""Grids of a benchmark: what runs with which settings, and what is wrong with a file, in words."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_have.benchmark.grid import Failures, Grid, GridError, merge, read_grid
from sb3_have.configuration import load_config
from sb3_have.envs.weather import WEATHERS
from sb3_have.train import Run

GRIDS = Path(__file__).parent.parent / "benchmarks" / "grids"


def write(folder: Path, **changes: Any) -> Path:
    given = {"methods": ["gve", "have"], "seeds": [0, 1], **changes}
    path = folder / "mine.yml"
    path.write_text(yaml.safe_dump({key: value for key, value in given.items() if value is not None}))
    return path


def test_order_is_seed_by_seed(tmp_path: Path) -> None:
    grid = read_grid(write(tmp_path))
    assert [job.name for job in grid.jobs()] == ["gve-0", "have-0", "gve-1", "have-1"]
    assert [job.name for job in grid.jobs(only=["have"])] == ["have-0", "have-1"]
    assert grid.name == "mine" and grid.weathers == WEATHERS and grid.failures is None
    with pytest.raises(GridError, match="--only: mine has no 'lve'"):
        grid.jobs(only=["lve"])


def test_method_wins_in_its_policy_kwargs_and_the_grid_elsewhere() -> None:
    env_kwargs = {"modalities": ["rgb"], "image_size": 64}
    own = {"gamma": 0.9, "n_timesteps": 5, "env_kwargs": env_kwargs, "policy_kwargs": {"net_arch": [8]}}
    given = {
        "gamma": 0.98,
        "tau": 0.1,
        "env_kwargs": {"image_size": 32, "vehicles_count": 3},
        "policy_kwargs": {"net_arch": [16], "precision": "bfloat16"},
        "replay_buffer_kwargs": {"n_stack": 2},
    }
    assert merge(own, given) == {
        "gamma": 0.98,
        "tau": 0.1,
        "env_kwargs": {"modalities": ["rgb"], "image_size": 32, "vehicles_count": 3},
        "policy_kwargs": {"net_arch": [8], "precision": "bfloat16"},
        "replay_buffer_kwargs": {"n_stack": 2},
    }
    assert merge({"gamma": 0.9}, {}) == {"gamma": 0.9}, "no empty mappings, which a run's settings would tell"


def test_settings_are_those_of_a_plain_run(tmp_path: Path) -> None:
    """So a run that ``sb3_have.train`` began is taken up."""
    job = read_grid(write(tmp_path, hyperparams={"batch_size": 32})).jobs()[1]
    config = load_config("have", "HighwayVision-v0") | {"batch_size": 32}
    plain = Run(config, "HighwayVision-v0", tmp_path, seed=0)
    ours = Run(job.config, job.grid.env, tmp_path, seed=job.seed, algo=job.algo)
    assert ours._settings() == plain._settings()
    assert ours._settings()["config"]["batch_size"] == 32


def test_modalities_reach_methods_of_several(tmp_path: Path) -> None:
    three = ["rgb", "event", "depth"]
    grid = read_grid(write(tmp_path, methods=["rgb", "have"], modalities=three))
    assert [job.config["env_kwargs"]["modalities"] for job in grid.jobs()[:2]] == [["rgb"], three]


def test_algorithm_follows_from_the_method(tmp_path: Path) -> None:
    grid = read_grid(write(tmp_path, methods=["tqc", "crossq", "gve"], seeds=[3]))
    assert [job.algo for job in grid.jobs()] == ["tqc", "crossq", "havesac"]


def test_method_may_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "wide.yml").write_text("HighwayVision-v0: {policy: MultiInputPolicy, gamma: 0.5}")
    job = read_grid(write(tmp_path, methods=["own/wide.yml"])).jobs()[0]
    assert job.name == "wide-0" and job.config["gamma"] == 0.5


def test_what_does_not_reach_a_method_is_told(tmp_path: Path) -> None:
    given = {"policy_kwargs": {"net_arch": [8], "precision": "float32"}}
    grid = read_grid(write(tmp_path, methods=["gve-wide", "have"], hyperparams=given))
    own = {"pi": [256, 256], "qf": [454, 454]}
    assert grid.overruled() == [f"gve-wide keeps its own policy_kwargs.net_arch: {own}, not [8]"]
    with pytest.raises(GridError, match=r"policy_kwargs\.net_arch: \[8\] reaches no method"):
        read_grid(write(tmp_path, methods=["gve-wide"], hyperparams=given))


def test_image_size_of_the_grid_reaches_every_method(tmp_path: Path) -> None:
    given = {"env_kwargs": {"image_size": 32}}
    grid = read_grid(write(tmp_path, methods=["rgb", "have"], hyperparams=given))
    assert grid.overruled() == []
    told = [(job.config["env_kwargs"]["image_size"], job.config["env_kwargs"]["modalities"]) for job in grid.jobs()]
    assert told[:2] == [(32, ["rgb"]), (32, ["rgb", "event"])]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methodes": ["have"]}, "unknown key 'methodes'; did you mean 'methods'?"),
        ({"seeds": None}, "'seeds' is missing"),
        ({"methods": ["hvae"]}, "methods: there is no zoo_configs/hvae.yml; did you mean 'have'?"),
        ({"methods": ["gone.yml"]}, "methods: there is no file 'gone.yml'"),
        ({"methods": []}, "methods: expected a list of names, got []"),
        ({"methods": "have"}, "methods: expected a list of names, got 'have'"),
        ({"methods": ["have", "have"]}, "methods: 'have' is there twice"),
        ({"seeds": [0, -1]}, "seeds: expected a list of whole numbers >= 0, got [0, -1]"),
        ({"seeds": [0, 1, 0]}, "seeds: 0 is there twice"),
        ({"weathers": ["ClearNoon", "ClearNite"]}, "weathers: there is no 'ClearNite'; did you mean 'ClearNight'?"),
        ({"steps": 0}, "steps: expected a whole number >= 1, got 0"),
        ({"steps": 10.5}, "steps: expected a whole number >= 1, got 10.5"),
        ({"eval_episodes": True}, "eval_episodes: expected a whole number >= 1, got True"),
        ({"env": "HighwayVision-v9"}, "env: 'HighwayVision-v9' is not registered"),
        ({"env": "no_such_module:Drive-v0"}, "env: 'no_such_module:Drive-v0' is not registered"),
        ({"env": "Pendulum-v1"}, "has no block for 'Pendulum-v1'"),
        ({"hyperparams": {"batchsize": 3}}, "knows no 'batchsize'; did you mean 'batch_size'?"),
        ({"hyperparams": {"n_timesteps": 3}}, "hyperparams: n_timesteps does nothing here"),
        ({"hyperparams": {"env_kwargs": 3}}, "hyperparams: env_kwargs: expected keys and values, got 3"),
        (
            {"hyperparams": {"env_kwargs": {"modalities": ["rgb", "depth"]}}},
            "put them under the grid's own key modalities: ['rgb', 'depth']",
        ),
        ({"hyperparams": {"learning_rate": "1e-3"}}, "learning_rate: 1e-3 is a word in YAML; write !!float 1e-3"),
        ({"hyperparams": {"policy_kwargs": {"p": "1e3"}}}, "hyperparams: p: 1e3 is a word in YAML"),
        ({"modalities": ["rgb", "evnt"]}, "modalities: there is no 'evnt'; did you mean 'event'?"),
        ({"hyperparams": [3]}, "hyperparams: expected keys and values"),
        ({"failures": {"severity": 1}}, "failures: 'kinds' is missing"),
        ({"failures": {"kinds": ["blak"]}}, "failures: kinds: there is no 'blak'; did you mean 'black'?"),
        ({"failures": {"kinds": ["black"], "severity": 4}}, "failures: severity: expected one of 1 to 3, got 4"),
        ({"failures": {"kinds": ["black"], "episodes": 11}}, "failures: episodes: 11 is more than final_episodes, 10"),
    ],
)
def test_wrong_grid_is_told(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(GridError, match=re.escape(message)) as error:
        read_grid(path)
    assert str(error.value).startswith(str(path))


def test_file_that_is_no_grid(tmp_path: Path) -> None:
    path = tmp_path / "mine.yml"
    for text, message in [("a: [", "is not YAML"), ("have", "expected keys and values")]:
        path.write_text(text)
        with pytest.raises(GridError, match=message):
            read_grid(path)


def test_values_are_read(tmp_path: Path) -> None:
    failures = {"kinds": ["black", "noise"], "severity": 2}
    grid = read_grid(write(tmp_path, steps=3e4, failures=failures, weathers=["WetNoon"]))
    assert grid.steps == 30_000 and isinstance(grid.steps, int)
    assert grid.failures == Failures(("black", "noise"), severity=2, episodes=1)
    assert grid.weathers == ("WetNoon",)


@pytest.mark.parametrize("path", sorted(GRIDS.glob("*.yml")), ids=lambda path: path.stem)
def test_shipped_grid(path: Path) -> None:
    grid = read_grid(path)
    assert grid.steps >= 30_000 and grid.final_episodes >= 10 and len(grid.seeds) >= 3
    assert grid.weathers == WEATHERS and grid.overruled() == []


def test_shipped_grids_train_alike() -> None:
    """Core and extended go into the same tables."""
    core, extended = (read_grid(GRIDS / f"{name}.yml") for name in ("core", "extended"))
    common = {name: value for name, value in vars(core).items() if name not in ("name", "methods", "seeds")}
    assert common == {name: vars(extended)[name] for name in common}
    assert set(core.methods).isdisjoint(extended.methods)
    assert isinstance(core, Grid)


def test_a_carla_server_has_one_environment(tmp_path: Path) -> None:
    path = tmp_path / "carla.yml"
    text = "env: CarlaVision-v0\nmethods: [have]\nseeds: [0]\n"
    path.write_text(text)
    with pytest.raises(GridError, match="eval_envs: 1"):
        read_grid(path)
    path.write_text(text + "eval_envs: 1\n")
    assert read_grid(path).eval_envs == 1
