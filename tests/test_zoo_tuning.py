"""The search for hyper-parameters: what it draws for HAVESAC, what it keeps, and several processes at one study."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zoo_fixtures
from zoo_fixtures import SMALL, VECTORS, saved

from sb3_have import HAVESAC, tuning, zoo
from sb3_have.common.tqc import MultiModalTQCPolicy
from sb3_have.configuration import algorithm_of, config_names, load_config, model_kwargs, read_config
from sb3_have.train import make_training_env
from sb3_have.tuning import convert_havesac_params, sample_havesac_params

zoo_patches = zoo_fixtures.zoo_patches
optuna = pytest.importorskip("optuna", reason="needs pip install 'sb3_have[zoo]'")
DRAWN: dict[str, Any] = {
    "learning_rate": 5e-4, "one_minus_gamma": 0.05, "tau": 0.02, "batch_size_pow": 6, "train_freq": 4,
    "policy_delay": 2, "modality_dropout": 0.25, "net_arch": "small", "features_dim": 32, "local_coef": 0.5,
    "refusion": "monotone",
}  # fmt: skip
NOT_DRAWN = {
    "gve": {"local_coef", "refusion"},
    "lve": {"refusion"},
    "have-paper": {"local_coef", "refusion"},
    "lve-paper": {"local_coef", "refusion"},
    **{name: {"local_coef", "refusion"} for name in ("concat", "deepmdp", "gve-wide")},
}
METHODS = [name for name in config_names() if algorithm_of(name) == "havesac" and VECTORS in read_config(name)]
#: A search of seconds.
SEARCH = ["--env", VECTORS, "-n", "120", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
SEARCH += ["--device", "cpu", "--pruner", "none"]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    yield
    optuna.logging.set_verbosity(before)


def study_of(folder: Path, name: str) -> Any:
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "optuna.log"))
    return optuna.load_study(study_name=name, storage=optuna.storages.JournalStorage(backend))


def test_what_is_drawn_is_converted() -> None:
    trial = optuna.trial.FixedTrial(DRAWN)
    expected = {
        **{key: DRAWN[key] for key in DRAWN if key not in ("net_arch", "features_dim")},
        "gamma": 0.95,
        "batch_size": 64,
        "policy_kwargs": {"net_arch": [64, 64], "features_dim": 32},
    }
    del expected["one_minus_gamma"], expected["batch_size_pow"]
    assert sample_havesac_params(trial, 2, 1, {}) == expected == convert_havesac_params(DRAWN)
    assert trial.user_attrs == {"gamma": 0.95, "batch_size": 64}
    sample_havesac_params(trial, 2, 1, {})["policy_kwargs"]["net_arch"].append(1)
    assert tuning.NET_ARCH["small"] == [64, 64]


@pytest.mark.parametrize("name", METHODS)
def test_what_makes_a_method_is_not_drawn(name: str) -> None:
    """And every draw is one that HAVESAC takes."""
    config = load_config(name, VECTORS)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    env = make_training_env(VECTORS, config)
    for _ in range(3):
        trial = study.ask()
        sampled = sample_havesac_params(trial, 2, 1, {"hyperparams": config})
        assert set(trial.params) == set(DRAWN) - NOT_DRAWN.get(name, set())
        assert convert_havesac_params(trial.params) == sampled
        model = HAVESAC(env=env, device="cpu", **{**model_kwargs(config), **sampled})
        assert model.critic.value_estimation == config.get("value_estimation", "have")
        assert 0.9 <= model.gamma <= 0.995 and model.batch_size in (32, 64, 128, 256)
    env.close()


def test_search_keeps_policy_kwargs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search merges those of the configuration with the sampled ones, and so does the training of a trial."""
    built: list[dict[str, Any]] = []

    class Recorded(HAVESAC):
        def __init__(self, *args: Any, **kwargs: Any):
            built.append(kwargs)
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(zoo, "HAVESAC", Recorded)
    given = ["--method", "lve", "-f", str(tmp_path)]
    params = ["-params", *SMALL, "policy_kwargs:dict(attention_dim=5, net_arch=[3], activation_fn=nn.Tanh)"]
    zoo.main(["tune", *given, *SEARCH, "--n-trials", "2", *params])
    trials = study_of(tmp_path, f"lve-{VECTORS}").trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "COMPLETE"]
    assert len(built) == 2
    for trial, kwargs in zip(trials, built, strict=True):
        drawn = convert_havesac_params(trial.params)
        kept = {"attention_dim": 5, "activation_fn": type(kwargs["policy_kwargs"]["activation_fn"]())}
        assert kwargs["policy_kwargs"] == {**kept, **drawn["policy_kwargs"]}
        assert kwargs["policy_kwargs"]["activation_fn"].__name__ == "Tanh"
        assert kwargs["value_estimation"] == "lve" and kwargs["buffer_size"] == 300
        assert (kwargs["gamma"], kwargs["batch_size"]) == (drawn["gamma"], drawn["batch_size"])
    (report,) = (tmp_path / "havesac").glob("*.csv")
    assert report.name.startswith("report_")
    assert not list((tmp_path / "havesac").glob(f"{VECTORS}_*")), "a search leaves no folder that enjoy would open"

    for number, trial in enumerate(trials):  # the Zoo takes 0 for none
        built.clear()
        folder = tmp_path / f"trial-{number}"
        options = ["--env", VECTORS, "-n", "20", "--eval-freq", "-1", "--trial-id", str(number)]
        storage = ["--storage", str(tmp_path / "optuna.log"), "-params", "buffer_size:40", "tau:0.5"]
        zoo.main(["train", "--method", "lve", "-f", str(folder), *options, *storage])
        drawn = convert_havesac_params(trial.params)
        (kwargs,) = built
        # the configuration's, since the command line gave none this time
        assert kwargs["policy_kwargs"] == {**load_config("lve", VECTORS)["policy_kwargs"], **drawn["policy_kwargs"]}
        assert (kwargs["gamma"], kwargs["local_coef"]) == (drawn["gamma"], drawn["local_coef"])
        assert (kwargs["tau"], kwargs["buffer_size"]) == (0.5, 40)
        assert saved(folder, "args.yml")["study_name"] == f"lve-{VECTORS}"
        assert saved(folder, "config.yml")["gamma"] == drawn["gamma"]


def test_search_for_tqc_keeps_the_encoders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rl_zoo3
    from sb3_contrib import TQC

    built: list[dict[str, Any]] = []

    class Recorded(TQC):
        def __init__(self, *args: Any, **kwargs: Any):
            built.append(kwargs)
            super().__init__(*args, **kwargs)

    monkeypatch.setitem(rl_zoo3.ALGOS, "tqc", Recorded)
    zoo.main(["tune", "--method", "tqc", "-f", str(tmp_path), *SEARCH, "--n-trials", "1", "-params", *SMALL])
    (kwargs,) = built
    assert kwargs["policy"] is MultiModalTQCPolicy
    assert kwargs["policy_kwargs"]["features_extractor_kwargs"] == {"features_dim": 32}
    assert {"net_arch", "n_quantiles"} <= set(kwargs["policy_kwargs"])


def test_defaults_of_a_search() -> None:
    arguments = zoo.zoo_arguments("tune", ["--method", "lve", "--env", VECTORS])
    for words in (
        ["--storage", "logs/lve/optuna.log"],
        ["--study-name", f"lve-{VECTORS}"],
        ["--n-evaluations", "3"],
        ["--eval-episodes", "10"],
    ):
        assert arguments.count(words[0]) == 1 and arguments[arguments.index(words[0]) + 1] == words[1]
    assert "--optimize-hyperparameters" in arguments
    own = ["--storage", "postgresql://user@host/optuna", "--study-name", "mine", "--eval-episodes", "2"]
    arguments = zoo.zoo_arguments("tune", ["--algo", "havesac", "--env", VECTORS, *own])
    # the last of each is heeded
    assert [arguments[len(arguments) - arguments[::-1].index(word)] for word in own[::2]] == own[1::2]


def test_two_processes_share_a_study(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sb3_have.zoo", "tune", "--algo", "havesac", *SEARCH, "--n-trials", "2"]
    command += ["-f", str(tmp_path), "--num-threads", "1", "-params", *SMALL]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) for _ in range(2)]
    printed = [process.communicate()[0].decode() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], "\n".join(printed)
    trials = study_of(tmp_path, f"have-{VECTORS}").trials
    assert sorted(trial.number for trial in trials) == [0, 1, 2, 3]
    assert all(trial.state.is_finished() for trial in trials)
