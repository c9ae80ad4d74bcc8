"""Grids of a benchmark: the runs and their settings, and the errors of wrong files."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from sb3_have.benchmark.grid import FINAL_SEED, Failures, GridError, merge, read_grid
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
    with pytest.raises(GridError, match="--only: unknown name 'lve'"):
        grid.jobs(only=["lve"])


def test_hyperparams_of_the_grid_override_those_of_a_method() -> None:
    env_kwargs = {"modalities": ["rgb"], "image_size": 64}
    own = {"gamma": 0.9, "n_timesteps": 5, "env_kwargs": env_kwargs, "policy_kwargs": {"net_arch": [8]}}
    given = {
        "gamma": 0.98,
        "tau": 0.1,
        "env_kwargs": {"image_size": 32, "vehicles_count": 3},
        "policy_kwargs": {"net_arch": [8], "precision": "bfloat16"},
        "replay_buffer_kwargs": {"n_stack": 2},
    }
    assert merge(own, given) == {
        "gamma": 0.98,
        "tau": 0.1,
        "env_kwargs": {"modalities": ["rgb"], "image_size": 32, "vehicles_count": 3},
        "policy_kwargs": {"net_arch": [8], "precision": "bfloat16"},
        "replay_buffer_kwargs": {"n_stack": 2},
    }
    assert merge({"gamma": 0.9}, {}) == {"gamma": 0.9}, "no empty mappings, which would appear in the settings"
    with pytest.raises(GridError, match=r"policy_kwargs\.net_arch is part of a method, which has \[8\]"):
        merge(own, {"policy_kwargs": {"net_arch": [16]}})


def test_settings_are_those_of_a_plain_run(tmp_path: Path) -> None:
    """So a benchmark resumes a run that ``sb3_have.train`` began."""
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


def test_image_size_of_the_grid_reaches_every_method(tmp_path: Path) -> None:
    given = {"env_kwargs": {"image_size": 32}}
    grid = read_grid(write(tmp_path, methods=["rgb", "have"], hyperparams=given))
    reached = [(job.config["env_kwargs"]["image_size"], job.config["env_kwargs"]["modalities"]) for job in grid.jobs()]
    assert reached[:2] == [(32, ["rgb"]), (32, ["rgb", "event"])]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methodes": ["have"]}, "unknown key 'methodes'; did you mean 'methods'?"),
        ({"seeds": None}, "the key 'seeds' is missing"),
        ({"methods": ["hvae"]}, "methods: there is no configuration 'hvae'"),
        ({"methods": ["hvae"]}, "; did you mean 'have'?"),
        ({"methods": []}, "methods: Tuple should have at least 1 item after validation, not 0, got []"),
        ({"methods": ["have", "have"]}, "methods: 'have' is listed twice"),
        ({"methods": ["have", "mine/have.yml"]}, "methods: 'have' is listed twice"),
        ({"seeds": [0, -1]}, "seeds: a seed must be 0 or more, got [0, -1]"),
        ({"seeds": [0, 1, 0]}, "seeds: '0' is listed twice"),
        ({"weathers": ["ClearNoon", "ClearNite"]}, "weathers: unknown name 'ClearNite'; did you mean 'ClearNight'?"),
        ({"steps": 0}, "steps: Input should be greater than or equal to 1, got 0"),
        ({"steps": 10.5}, "steps: Input should be a valid integer, got a number with a fractional part, got 10.5"),
        ({"env": "HighwayVision-v9"}, "env: it is not registered"),
        ({"env": "no_such_module:Drive-v0"}, "(No module named 'no_such_module'), got 'no_such_module:Drive-v0'"),
        ({"env": "Pendulum-v1"}, "has no block for 'Pendulum-v1'"),
        ({"hyperparams": {"batchsize": 3}}, "unknown name 'batchsize'; did you mean 'batch_size'?"),
        ({"hyperparams": {"n_timesteps": 3}}, "hyperparams: n_timesteps has no effect here"),
        ({"hyperparams": {"env_kwargs": 3}}, "hyperparams: env_kwargs must be a mapping"),
        ({"hyperparams": {"env_kwargs": {"modalities": ["rgb", "depth"]}}}, "use the grid's key 'modalities'"),
        ({"hyperparams": {"policy_kwargs": {"p": "1e3"}}}, "YAML reads p: 1e3 as text; write p: !!float 1e3"),
        ({"modalities": ["rgb", "evnt"]}, "modalities: unknown name 'evnt'; did you mean 'event'?"),
        ({"failures": {"severity": 1}}, "the key 'failures.kinds' is missing"),
        ({"failures": {"kinds": ["black"], "sverity": 1}}, "unknown key 'failures.sverity'; did you mean 'severity'?"),
        ({"failures": {"kinds": ["blak"]}}, "failures.kinds: unknown name 'blak'; did you mean 'black'?"),
        (
            {"failures": {"kinds": ["black"], "severity": 4}},
            "failures.severity: Input should be less than or",
        ),
        (
            {"methods": ["gve-wide"], "hyperparams": {"policy_kwargs": {"net_arch": [8]}}},
            "net_arch is part of a method",
        ),
        ({"failures": {"kinds": ["black"], "episodes": 11}}, "failures.episodes: 11 is more than final_episodes, 10"),
    ],
)
def test_wrong_grids(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
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
    assert grid.failures == Failures(kinds=("black", "noise"), severity=2, episodes=1)
    assert grid.weathers == ("WetNoon",)


@pytest.mark.parametrize(
    "path", sorted([*GRIDS.glob("*.yml"), *GRIDS.glob("search/*.yml")]), ids=lambda path: path.stem
)
def test_shipped_grid(path: Path) -> None:
    grid = read_grid(path)
    assert grid.steps >= 30_000 and len(grid.seeds) >= 3
    assert grid.weathers == WEATHERS
    # A search uses other episodes than the tables
    assert (path.parent.name == "search") == (grid.final_seed != FINAL_SEED)


def test_shipped_grids_train_alike() -> None:
    """Core and extended go into the same tables."""
    core, extended = (read_grid(GRIDS / f"{name}.yml") for name in ("core", "extended"))
    first, second = (grid.model_dump(exclude={"methods", "seeds"}) for grid in (core, extended))
    assert first == second
    assert set(core.methods).isdisjoint(extended.methods)


def test_a_carla_server_has_one_environment(tmp_path: Path) -> None:
    path = tmp_path / "carla.yml"
    text = "env: CarlaVision-v0\nmethods: [have]\nseeds: [0]\n"
    path.write_text(text)
    with pytest.raises(GridError, match="eval_envs: 1"):
        read_grid(path)
    path.write_text(text + "eval_envs: 1\n")
    assert read_grid(path).eval_envs == 1
