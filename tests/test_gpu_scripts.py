"""What a GPU would have to wait for in ``train``, and the scripts of benchmarks/gpu as far as a CPU can run them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch as th
from envs import fill_buffer, sensors_space, tiny_model
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from torch.distributions import Normal
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from typing_extensions import Self

from benchmarks import update_speed
from benchmarks.gpu import checks, graph, training
from sb3_have import HAVESAC
from sb3_have.have import policies

ROOT = Path(__file__).parent.parent
DATA_DEPENDENT = {th.Tag.data_dependent_output, th.Tag.dynamic_output_shape}
aten = th.ops.aten


class Copies(TorchFunctionMode):
    """Notes what copies a tensor to the host; on a CPU these are no operations."""

    def __init__(self, found: list[str]):
        super().__init__()
        self.found = found

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        to_cpu = name == "to" and any(str(value) == "cpu" for value in (*args[1:], *(kwargs or {}).values()))
        if name in ("cpu", "numpy", "tolist", "__array__") or to_cpu:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


class Waits(TorchDispatchMode):
    """
    Notes every operation for which the host would wait for a GPU: reads of values (``item``, ``equal``, ``if tensor``),
    results whose shape depends on values (``nonzero``, boolean indices), checks within an operation
    (``normal`` with a tensor of standard deviations), constants that are made of Python's numbers and copied over, and
    copies to the host.

    :param on_host: a tensor that is on the host in any case
    """

    def __init__(self, on_host: th.Tensor | None = None):
        super().__init__()  # type: ignore[no-untyped-call]
        self.on_host, self.calls = on_host, 0
        self.found: list[str] = []
        self.copies = Copies(self.found)

    def __enter__(self) -> Self:
        self.copies.__enter__()  # type: ignore[no-untyped-call]
        super().__enter__()  # type: ignore[no-untyped-call]
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)  # type: ignore[no-untyped-call]
        self.copies.__exit__(*error)  # type: ignore[no-untyped-call]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.calls += 1
        if self._waits(func, args):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))

    def _waits(self, func: Any, args: Any) -> bool:
        packet = func.overloadpacket
        if packet is aten._local_scalar_dense and self.on_host is not None:
            return bool(args[0].data_ptr() != self.on_host.data_ptr())
        if packet in (aten.index, aten.index_put, aten.index_put_):  # by integers they read nothing
            return any(index is not None and index.dtype in (th.bool, th.uint8) for index in args[1])
        if func in (aten.normal.Tensor_Tensor, aten.normal.float_Tensor):
            return True
        return packet is aten.lift_fresh or bool(DATA_DEPENDENT & set(func.tags))


@pytest.mark.parametrize(
    "operation",
    [
        lambda x: x.sum().item(),
        lambda x: bool(x.any()),
        lambda x: th.equal(x, x),
        lambda x: x.nonzero(),
        lambda x: x[x > 0],
        lambda x: x.masked_select(x > 0),
        lambda x: x.index_put_((x > 0,), th.zeros_like(x.sum())),
        lambda x: th.normal(x, x.abs()),
        lambda x: Normal(x, x.abs(), validate_args=True),
        lambda x: x * th.tensor(2.0),
        lambda x: x.tolist(),
        lambda x: x.cpu(),
        lambda x: x.to("cpu"),
        lambda x: x.numpy(),
    ],
)
def test_what_waits_is_noticed(operation: Callable[[th.Tensor], object]) -> None:
    with Waits() as waits:
        operation(th.ones(3))
    assert waits.found


def test_what_does_not_wait_is_not() -> None:
    index = th.arange(2)
    with Waits() as waits:
        x = th.ones(3, requires_grad=True)
        loss = (x[index].clamp(min=0) * 2 + Normal(x, x.exp(), validate_args=False).rsample().min()).mean()
        loss.backward()  # type: ignore[no-untyped-call]
    assert waits.calls > 5 and not waits.found


@pytest.fixture
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the package does otherwise on a CPU: images decoded by a table, torch's check of the actor's outputs."""

    def proba_distribution(self: Any, mean_actions: th.Tensor, log_std: th.Tensor) -> Any:
        self.distribution = Normal(mean_actions, log_std.exp(), validate_args=False)
        return self

    monkeypatch.setattr(th.jit, "is_tracing", lambda: True)  # no table then, as on a GPU
    monkeypatch.setattr(policies.SquashedGaussian, "proba_distribution", proba_distribution)


def ready_model(**kwargs: Any) -> tuple[HAVESAC, graph.StaticBatch]:
    """A model that reads no losses, as on a GPU, and a batch that stays on the device."""
    model = tiny_model(sensors_space(), kwargs.pop("policy_kwargs", None), **kwargs)
    fill_buffer(model, 30)
    model.device = th.device("cuda")  # only what `train` makes of it
    assert model.replay_buffer is not None
    samples = model.replay_buffer.sample(8)
    assert isinstance(samples, DictReplayBufferSamples)
    return model, graph.StaticBatch(samples, "cpu")


@pytest.mark.usefixtures("as_on_a_gpu")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"modality_dropout": 0.3, "policy_delay": 2, "target_update_interval": 2},
        {"target": "paper", "refusion": "free", "local_coef": 0.0},
        {"refusion": "monotone", "n_steps": 3},
        {"random_shift": 4, "n_augmentations": 2},
        {"value_estimation": "lve", "auxiliary": None},
        {"value_estimation": "gve", "ent_coef": 0.1},
        {"policy_kwargs": {"precision": "bfloat16"}},
    ],
    ids=str,
)
def test_no_update_waits_for_a_gpu(options: dict[str, Any]) -> None:
    """Neither values read nor constants made: what is left is the count of steps of SB3's temperature optimizer."""
    model, batch = ready_model(**options)
    model.replay_buffer = batch  # type: ignore[assignment]
    model.train(2, 8)
    steps = None
    if model.ent_coef_optimizer is not None:
        ((state),) = model.ent_coef_optimizer.state.values()
        steps = state["step"]  # on the host for a GPU's parameters too
    with Waits(on_host=steps) as waits:
        model.train(4, 8)
    assert waits.calls > 500 and not waits.found


@pytest.mark.usefixtures("as_on_a_gpu")
def test_no_recorded_update_waits_for_a_gpu() -> None:
    """Nor does it with capturable optimizers, whose counts of steps no graph could read."""
    update = graph.GraphedUpdate(tiny_model(sensors_space()), 8)
    fill_buffer(update.model, 30)
    update()
    with Waits() as waits:
        update._train()
    assert waits.calls > 100
    reads = ["aten._local_scalar_dense.default"]
    assert set(waits.found) <= set(reads)  # the losses, which are read on a CPU
    assert len(waits.found) == len(graph.losses_of(update.model))


# -- The recorded update


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"policy_delay": 2, "target_update_interval": 3},
        {"modality_dropout": 0.3, "random_shift": 4},
        {"ent_coef": 0.1, "n_steps": 3},
    ],
    ids=str,
)
def test_recorded_update_is_the_update(monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]) -> None:
    monkeypatch.setattr(update_speed, "BUFFER_SIZE", 30)
    losses, parameters = graph.difference("cpu", image_size=36, batch_size=2, updates=6, **options)
    assert losses < 1e-4 and parameters < 1e-4


def test_recorded_update_follows_the_learning_rate_and_counts() -> None:
    model = tiny_model(sensors_space())
    fill_buffer(model, 30)
    model.lr_schedule = lambda progress: 1e-3 * progress
    schedule = model.lr_schedule
    update = graph.GraphedUpdate(model, 8)
    for progress in (1.0, 0.5):
        model._current_progress_remaining = progress
        update()
        assert float(update.learning_rate) == pytest.approx(1e-3 * progress)
        assert model.critic.optimizer.param_groups[0]["lr"] is update.learning_rate
        assert model.logger.name_to_value["train/learning_rate"] == 1e-3 * progress
    assert model._n_updates == 2 and model.lr_schedule is schedule and isinstance(model.replay_buffer, ReplayBuffer)


def test_what_no_graph_can_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="use_sde"):
        graph.GraphedUpdate(tiny_model(sensors_space(), use_sde=True), 8)
    with pytest.raises(ValueError, match="SGD"):
        graph.GraphedUpdate(tiny_model(sensors_space(), {"optimizer_class": th.optim.SGD}), 8)


def test_goals_in_words() -> None:
    row = {"storage": "device", "host_share": 0.1}
    rows = [{**row, "contender": "HAVESAC", "vs_sb3": 3.5}, {**row, "contender": "HAVESAC graph", "vs_sb3": 12.0}]
    assert [line.rpartition(" ")[2] for line in graph.goals(rows)] == ["missed", "met", "met"]


# -- The checks


def test_checks_hold_and_failures_stop_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(setting: checks.Setting) -> checks.Result:
        raise RuntimeError("no such thing")

    names = ["losses", "replay device", "save here, load on cpu", "adam"]
    known = {"broken": broken, **{name: check for name, check in checks.checks(SETTING).items() if name in names}}
    monkeypatch.setattr(checks, "checks", lambda setting: known)
    assert checks.run(["broken", *names], SETTING, tmp_path / "rows.csv") == 1
    rows = pd.read_csv(tmp_path / "rows.csv").set_index("check")
    assert list(rows.index) == ["broken", *names]
    assert rows["ok"].tolist() == [False] + [True] * len(names)
    assert rows.loc["broken", "detail"] == "RuntimeError: no such thing"


SETTING = checks.Setting("cpu", image_size=36, batch_size=2)


def test_a_wrong_loss_fails_its_check(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference is computed first, then what is checked."""
    correct, calls = HAVESAC._critic_loss, []

    def wrong(self: HAVESAC, *args: Any) -> th.Tensor:
        calls.append(1)
        return correct(self, *args) * (1.0 if len(calls) == 1 else 1.01)

    monkeypatch.setattr(HAVESAC, "_critic_loss", wrong)
    ok, detail = checks.check_losses(SETTING, tolerance=1e-3)
    assert not ok and "critic" in detail and len(calls) == 2


def test_difference_of_tensors() -> None:
    a = {"x": th.tensor([3.0, 4.0]), "y": th.ones(2)}
    assert graph.relative_difference(a, a)[0] == 0
    value, name = graph.relative_difference(a, {**a, "x": th.tensor([3.0, 4.5])})
    assert value == pytest.approx(0.1, abs=1e-4) and name == "x"
    assert graph.relative_difference(a, {**a, "y": th.tensor([1.0, th.nan])}) == (np.inf, "y")
    with pytest.raises(ValueError, match="y"):
        graph.relative_difference(a, {"x": a["x"]})


# -- Runs, and what they need


def test_what_a_run_has_come_to(tmp_path: Path) -> None:
    assert training.result(tmp_path, None)["steps"] is None
    lines = ["#{}", "r,l,t,distance", *(f"{i},10,{i},{100 * i}" for i in range(20))]
    (tmp_path / "monitor.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "log.txt").write_text("Traceback\nValueError: why\n")
    row = training.result(tmp_path, 1)
    assert (row["episodes"], row["distance"], row["return"], row["error"]) == (20, 1450.0, 14.5, "ValueError: why")
    training.pack(tmp_path, tmp_path.parent / "curves.tar.gz")
    assert (tmp_path.parent / "curves.tar.gz").stat().st_size > 0


def test_wheels_are_pinned_and_ignored() -> None:
    script = (ROOT / "benchmarks" / "gpu" / "pack.sh").read_text()
    found = re.search(r"^PACKAGES=\((.*)\)$", script, re.MULTILINE)
    assert found is not None
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    for package in found[1].split():
        assert [line for line in pins if re.fullmatch(rf"{package}==[^;]*", line)], package
    assert "benchmarks/gpu/wheels/" in (ROOT / ".gitignore").read_text().splitlines()


def test_batch_size_of_update_speed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def measure(shape: update_speed.Shape, *args: Any, **kwargs: Any) -> list[dict[str, Any]]:
        assert (shape.image_size, shape.batch_size) == (64, 512)
        return [{"device": "cpu", "threads": 1, "modalities": 2, "contender": "HAVESAC"}]

    monkeypatch.setattr(update_speed, "measure", measure)
    output = tmp_path / "rows.csv"
    update_speed.main(["--shapes", "a", "--modalities", "2", "--batch-size", "512", "--output", str(output)])
    assert pd.read_csv(output)["options"].tolist() == ["default batch-size=512"]
