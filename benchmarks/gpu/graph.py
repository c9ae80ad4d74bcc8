"""Measure an update of HAVESAC as one CUDA graph, compared with SB3's SAC and the eager update.

    python -m benchmarks.gpu.graph --output graph.csv                       # at shape (b) of benchmarks.update_speed
    python -m benchmarks.gpu.graph --device cpu --image-size 36 --batch-sizes 8 --rounds 2     # tries the script

For each batch size there are rows for ``SB3 SAC``, ``HAVESAC``, ``HAVESAC graph`` (:class:`GraphedUpdate` with
sampling) and ``graph alone`` (without sampling), by the storage of the replay buffer. The columns are ``median_ms`` and
quartiles of the wall-clock time of an update, in rounds of ten on a GPU; ``vs_sb3``, how many times faster than SB3;
``host_ms``, the time until the call of one update returns, and ``host_share``, its share of the time until the GPU has
finished; ``kernels`` and ``kernel_ms``, the number of kernels of an update and the time that the GPU spends in them;
and ``error`` if no graph could be recorded.
"""

from __future__ import annotations

import argparse
import math
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show, synchronize
from benchmarks.random_sensors import CHANNELS, make_env
from benchmarks.update_speed import have_sac, ready, sb3_sac
from sb3_have import HAVESAC

TWO = {key: CHANNELS[key] for key in ("rgb", "event")}
GROUP = ("device", "image_size", "batch_size", "precision", "compile")
COLUMNS = ("contender", "storage", "median_ms", "vs_sb3", "host_ms", "host_share", "kernels", "kernel_ms", "error")
GOALS = {"HAVESAC": 4.0, "HAVESAC graph": 10.0}  # times faster than SB3
HOST_GOAL = 0.2
Step = Callable[[], object]
Samples = TypeVar("Samples", bound=tuple[Any, ...])


class StaticBatch:
    """
    Replay buffer that always returns the same tensors.

    :param samples: Samples to copy
    :param device: Device of the copies
    """

    def __init__(self, samples: DictReplayBufferSamples, device: th.device | str):
        self.samples = map_tensors(samples, lambda tensor: tensor.to(device, copy=True))

    def fill(self, samples: DictReplayBufferSamples) -> None:
        """Copy new values into the tensors."""
        for static, new in zip(tensors(self.samples), tensors(samples), strict=True):
            static.copy_(new, non_blocking=True)

    def sample(self, batch_size: int, env: Any = None) -> DictReplayBufferSamples:
        return self.samples


def tensors(samples: tuple[Any, ...]) -> Iterator[th.Tensor]:
    """Iterate over all tensors of a batch."""
    for value in samples:
        yield from value.values() if isinstance(value, dict) else () if value is None else (value,)


def map_tensors(samples: Samples, function: Callable[[th.Tensor], th.Tensor]) -> Samples:
    """Apply a function to each tensor of a batch."""
    values: list[Any] = [
        {key: function(tensor) for key, tensor in value.items()}
        if isinstance(value, dict)
        else (None if value is None else function(value))
        for value in samples
    ]
    return type(samples)(*values)


class GraphedUpdate:
    """
    One update of ``HAVESAC.train``, recorded as a CUDA graph. Each call is one update.

    The graph records ``model.train`` on a batch whose tensors do not move; a call samples into them and launches the
    graph. The first calls are eager, because libraries and optimizers initialise themselves. Updates with and without
    actor and target (``policy_delay``, ``target_update_interval``) have separate graphs. The learning rate is a tensor,
    so its schedule continues. All other numbers, such as ``auxiliary_coefs``, ``tau`` and ``gamma``, keep their values
    from the recording. The parameters must stay at their addresses.

    :param model: Model with Adam and a constant batch size; its optimizers become capturable
    :param batch_size: Batch size of every update
    :param warm_up: Number of eager updates before a graph is recorded
    :raises ValueError: With gSDE, because SB3 checks its standard deviations on the host
    """

    def __init__(self, model: HAVESAC, batch_size: int, warm_up: int = 3):
        if model.use_sde:
            raise ValueError("use_sde=True is not supported, because SB3 checks its standard deviations on the host")
        self.model, self.batch_size, self.warm_up = model, batch_size, warm_up
        self.batch: StaticBatch | None = None
        self.learning_rate = th.zeros((), device=model.device)
        self._rate: float | None = None
        self.stream: th.cuda.Stream | None = None
        if model.device.type == "cuda":
            self.stream = th.cuda.Stream(model.device)  # type: ignore[no-untyped-call]
        self.graphs: dict[tuple[bool, bool], tuple[th.cuda.CUDAGraph, dict[str, th.Tensor]]] = {}
        self.eager_calls: dict[tuple[bool, bool], int] = {}
        for optimizer in (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer):
            if optimizer is not None:
                make_capturable(optimizer)

    def __call__(self) -> None:
        model = self.model
        assert model.replay_buffer is not None
        samples = model.replay_buffer.sample(self.batch_size, env=model._vec_normalize_env)
        assert isinstance(samples, DictReplayBufferSamples)
        if self.batch is None:
            self.batch = StaticBatch(samples, model.device)
        else:
            self.batch.fill(samples)
        self.update()

    def update(self) -> None:
        """Update on the current batch."""
        model = self.model
        rate = float(model.lr_schedule(model._current_progress_remaining))
        if rate != self._rate:
            self.learning_rate.fill_(rate)
            self._rate = rate
        update = model._n_updates + 1
        due = update % model.policy_delay == 0, update % model.target_update_interval == 0
        n_eager = self.eager_calls.setdefault(due, 0)
        if self.stream is None:
            self._train()
        elif n_eager < self.warm_up:
            self.eager_calls[due] += 1
            self.stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self.stream):
                self._train()
            th.cuda.current_stream().wait_stream(self.stream)
        else:
            if due not in self.graphs:
                self.graphs[due] = self._record()
            graph, losses = self.graphs[due]
            graph.replay()  # type: ignore[no-untyped-call, unused-ignore]
            model._n_updates = update
            for name, loss in losses.items():
                model.logger.record(name, loss)
        model.logger.record("train/learning_rate", rate)
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _record(self) -> tuple[th.cuda.CUDAGraph, dict[str, th.Tensor]]:
        """Record a graph without running it; return it with its losses."""
        model = self.model
        n_updates = model._n_updates
        graph = th.cuda.CUDAGraph()
        with th.cuda.graph(graph, stream=self.stream):
            self._train()
        logged: dict[str, Any] = model.logger.name_to_value
        losses = {name: value for name, value in logged.items() if isinstance(value, th.Tensor)}
        model._n_updates = n_updates
        return graph, losses

    def _train(self) -> None:
        model = self.model
        buffer, schedule = model.replay_buffer, model.lr_schedule
        model.replay_buffer = self.batch  # type: ignore[assignment]
        model.lr_schedule = lambda _: self.learning_rate  # type: ignore[assignment, return-value]
        try:
            model.train(1, self.batch_size)
        finally:
            model.replay_buffer, model.lr_schedule = buffer, schedule


def make_capturable(optimizer: th.optim.Optimizer) -> None:
    """
    Let Adam keep its step count on the device, as a graph requires.

    :param optimizer: The optimizer
    :raises ValueError: If the optimizer is not Adam
    """
    if not isinstance(optimizer, th.optim.Adam):
        raise ValueError(f"{type(optimizer).__name__}: expected torch.optim.Adam.")
    for group in optimizer.param_groups:
        group.update(capturable=True, fused=True, foreach=False)
    optimizer.load_state_dict(optimizer.state_dict())  # moves the step count to the device


def losses_of(model: HAVESAC) -> dict[str, float]:
    """Get the losses of the last update."""
    names = (name for name in model.logger.name_to_value if name.endswith(("loss", "ent_coef")))
    return {name: float(model.logger.name_to_value[name]) for name in names}


def difference(device: str, image_size: int, batch_size: int, updates: int = 10, **kwargs: Any) -> tuple[float, float]:
    """
    Train two equal models on the same batches and random numbers, with ``train`` and with :class:`GraphedUpdate`.

    :param device: Device of the models
    :param image_size: Height and width of the images [px]
    :param batch_size: Batch size of an update
    :param updates: Number of updates
    :param kwargs: Arguments of HAVESAC
    :return: Largest relative difference of a loss, and of a parameter tensor
    """
    env = make_env(TWO, image_size)
    models = [have_sac(env, "float32", device, **kwargs) for _ in range(2)]
    ready(models, env)
    history: list[list[dict[str, float]]] = []
    with exact_arithmetic():
        for model, graphed in zip(models, (False, True), strict=True):
            th.manual_seed(0)
            np.random.seed(0)
            train: Callable[[], None] = (
                GraphedUpdate(model, batch_size) if graphed else lambda: models[0].train(1, batch_size)
            )
            history.append([])
            for _ in range(updates):
                train()
                history[-1].append(losses_of(model))
    losses = [loss_difference(theirs, ours)[0] for theirs, ours in zip(*history, strict=True)]
    return max(losses), relative_difference(*(parameters(model.policy) for model in models))[0]


def loss_difference(reference: dict[str, float], other: dict[str, float]) -> tuple[float, str]:
    """Find the largest relative difference of two losses with the same name (infinite for NaN), and the name."""
    worst = 0.0, ""
    for name, value in reference.items():
        difference = abs(other[name] - value) / (abs(value) + 1e-6)
        worst = max(worst, (difference if math.isfinite(difference) else math.inf, name))
    return worst


def parameters(module: th.nn.Module) -> dict[str, th.Tensor]:
    """Get the parameters by name."""
    return dict(module.named_parameters())


def relative_difference(reference: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> tuple[float, str]:
    """
    Find the largest ||b - a|| / ||a|| of two tensors with the same name, and the name.

    A millionth of the norm of all tensors is added to the denominator, for tensors that are zero up to rounding errors.
    """
    if reference.keys() != other.keys():
        raise ValueError(f"not in both: {sorted(reference.keys() ^ other.keys())}")
    worst = 0.0, ""
    floor = 1e-6 * float(sum(tensor.detach().cpu().double().square().sum() for tensor in reference.values()) ** 0.5)
    for name, tensor in reference.items():
        a, b = (values.detach().cpu().double() for values in (tensor, other[name]))
        if a.shape != b.shape:
            raise ValueError(f"{name}: {tuple(a.shape)} and {tuple(b.shape)}")
        value = float((b - a).norm() / (a.norm() + floor))
        worst = max(worst, (float("inf") if value != value else value, name))
    return worst


@contextmanager
def exact_arithmetic() -> Iterator[None]:
    """Disable TensorFloat-32 and use deterministic convolutions."""
    cudnn, matmul = th.backends.cudnn, th.backends.cuda.matmul
    before = cudnn.allow_tf32, matmul.allow_tf32, cudnn.deterministic
    cudnn.allow_tf32, matmul.allow_tf32, cudnn.deterministic = False, False, True
    try:
        yield
    finally:
        cudnn.allow_tf32, matmul.allow_tf32, cudnn.deterministic = before


def host_times(step: Step, repeats: int = 20) -> Row:
    """Measure how long the host is busy with one update, and its share of the time until the GPU has finished."""
    host, whole = [], []
    for _ in range(repeats):
        synchronize()
        start = time.perf_counter()
        step()
        host.append((time.perf_counter() - start) * 1e3)
        synchronize()
        whole.append((time.perf_counter() - start) * 1e3)
    share = np.median(np.array(host) / np.array(whole))
    return {"host_ms": round(float(np.median(host)), 3), "host_share": round(float(share), 3)}


def kernels(step: Step, repeats: int = 5) -> Row:
    """Count the kernels of an update, and the milliseconds that the GPU spends in them."""
    with th.profiler.profile(activities=[th.profiler.ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeats):
            step()
        th.cuda.synchronize()
    events = [
        event
        for event in profiler.events() or []
        if event.device_type.name == "CUDA"
        and not event.name.startswith(("Memcpy", "Memset"))
        and not getattr(event, "is_user_annotation", False)
    ]
    milliseconds = sum(float(event.time_range.elapsed_us()) for event in events) / 1e3
    return {"kernels": round(len(events) / repeats), "kernel_ms": round(milliseconds / repeats, 3)}


def measure(
    image_size: int, batch_size: int, precision: str, rounds: int, device: str, compile: bool = False
) -> tuple[list[Row], dict[tuple[str, str], Step]]:
    """
    Measure the contenders.

    :param image_size: Height and width of the images [px]
    :param batch_size: Batch size of an update
    :param precision: Precision of HAVESAC's encoders
    :param rounds: Number of rounds, with ten updates each on a GPU
    :param device: "cuda", or "cpu", where no graph is recorded
    :param compile: Whether HAVESAC compiles its modules
    :return: One row per contender, and their updates by name and storage
    """
    env = make_env(TWO, image_size)
    contenders: dict[tuple[str, str], Step] = {}
    rows: list[Row] = []
    sac = sb3_sac(env, False, device)
    ready([sac], env)
    contenders["SB3 SAC", "memory"] = lambda: sac.train(1, batch_size)

    def model(storage: str) -> HAVESAC:
        kwargs = {"replay_buffer_kwargs": {"storage": storage}, "compile": compile}
        return filled(env, precision, device, kwargs)

    for storage in ("memory", "device"):
        eager = model(storage)
        contenders["HAVESAC", storage] = lambda eager=eager: eager.train(1, batch_size)  # type: ignore[misc]
        try:
            graphed = GraphedUpdate(model(storage), batch_size)
            for _ in range(graphed.warm_up + 2):
                graphed()
            synchronize()
        except Exception:  # measure the others in any case
            traceback.print_exc()
            error = traceback.format_exc().strip().splitlines()[-1]
            rows.append({"contender": "HAVESAC graph", "storage": storage, "error": error})
        else:
            contenders["HAVESAC graph", storage] = graphed
            contenders["graph alone", storage] = graphed.update
    times = interleave(contenders, rounds, repeats=1 if device == "cpu" else 10)
    sb3 = times["SB3 SAC", "memory"].wall
    for (name, storage), (wall, _) in times.items():
        row: Row = {"contender": name, "storage": storage, **quartiles(wall)}
        row["vs_sb3"] = round(median_ratio(sb3, wall), 2)
        rows.append({**row, **host_times(contenders[name, storage])})
    settings: Row = {
        "device": device,
        "image_size": image_size,
        "batch_size": batch_size,
        "precision": precision,
        "compile": compile,
        "rounds": rounds,
    }
    return [{**settings, **dict.fromkeys(COLUMNS), **row} for row in rows], contenders


def filled(env: VecEnv, precision: str, device: str, kwargs: dict[str, Any]) -> HAVESAC:
    """Create a HAVESAC model with transitions to train on."""
    model = have_sac(env, precision, device, **kwargs)
    ready([model], env)
    return model


def goals(rows: Sequence[Row]) -> list[str]:
    """Format which goals are met."""
    lines = []
    for row in rows:
        name, ratio = row["contender"], row["vs_sb3"]
        if name in GOALS and ratio is not None:
            met = "met" if ratio >= GOALS[name] else "missed"
            lines.append(f"{name} ({row['storage']}): {ratio} times SB3, goal {GOALS[name]:g} {met}")
        if name == "HAVESAC graph" and row["host_share"] is not None:
            met = "met" if row["host_share"] < HOST_GOAL else "missed"
            lines.append(
                f"{name} ({row['storage']}): host {row['host_share']:.0%} of a step, goal {HOST_GOAL:.0%} {met}"
            )
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--image-size", type=int, default=128)
    parser.add_argument("--batch-sizes", type=int, nargs="+", default=[128, 512])
    parser.add_argument("--precision", default="bfloat16", choices=("float32", "bfloat16"))
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--compile", action="store_true", help="use HAVESAC(compile=True)")
    parser.add_argument("--output", type=Path, default=RESULTS / "gpu" / "graph.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    cv2.setNumThreads(1)
    about = machine(args.device)
    print(*about.values(), sep="\n", flush=True)
    measured = []
    for batch_size in args.batch_sizes:
        rows, steps = measure(args.image_size, batch_size, args.precision, args.rounds, args.device, args.compile)
        measured.append((rows, steps))
        print(f"\n{args.image_size}x{args.image_size} px, batch {batch_size}, {args.precision}", flush=True)
        show(rows, COLUMNS)
        print(*goals(rows), sep="\n", flush=True)
        save([{**row, **about} for row in rows], args.output, GROUP)
    if args.device == "cpu":
        return
    for rows, steps in measured:  # last, because the profiler may affect later measurements
        for row in rows:
            if row["error"] is None:
                row.update(kernels(steps[row["contender"], row["storage"]]))
        show(rows, COLUMNS)
        save([{**row, **about} for row in rows], args.output, GROUP)


if __name__ == "__main__":
    main()
