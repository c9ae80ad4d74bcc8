"""Check that training on a device computes the same as on a CPU, and that the host does not wait for the device.

    python -m benchmarks.gpu.checks --output correctness.csv
    python -m benchmarks.gpu.checks --device cpu --image-size 36 --batch-size 8      # tries the script

The script appends a row after each check, with its name, whether it passed, details and seconds. A failed check does
not stop the others; the exit code is 1 if any failed. ``--only`` selects checks by parts of their names.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from torch.distributions import Normal

from benchmarks.gpu.graph import (
    TWO,
    GraphedUpdate,
    StaticBatch,
    difference,
    exact_arithmetic,
    loss_difference,
    losses_of,
    parameters,
    relative_difference,
    tensors,
)
from benchmarks.measure import RESULTS, machine
from benchmarks.random_sensors import make_env, transitions
from sb3_have import HAVESAC, ModalityReplayBuffer, load_checkpoint, save_checkpoint
from sb3_have.common.encoders import has_native_bfloat16

COLUMNS = ("check", "ok", "detail", "seconds", "device")
TRANSITIONS = 120
Result = tuple[bool, str]
Check = Callable[["Setting"], Result]


class Setting:
    """
    Settings of the checks.

    :param device: Device to check
    :param image_size: Height and width of the images [px]
    :param batch_size: Batch size of an update
    """

    def __init__(self, device: str, image_size: int, batch_size: int):
        self.device, self.image_size, self.batch_size = device, image_size, batch_size
        self.cuda = th.device(device).type == "cuda"

    def model(self, device: str | None = None, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> HAVESAC:
        """Create a model with a filled replay buffer."""
        model = self.empty_model(device, policy_kwargs, **kwargs)
        assert model.env is not None and model.replay_buffer is not None
        for transition in transitions(model.env, TRANSITIONS):
            model.replay_buffer.add(*transition)
        model.set_logger(configure(None, []))
        return model

    def empty_model(
        self, device: str | None = None, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any
    ) -> HAVESAC:
        """Create a model with an empty replay buffer."""
        policy_kwargs = {"net_arch": [256, 256], "precision": "float32", **(policy_kwargs or {})}
        settings = {"buffer_size": 500, "learning_starts": 20, "batch_size": self.batch_size, "seed": 0, **kwargs}
        env = make_env(TWO, self.image_size, episode_length=25)
        device = self.device if device is None else device
        return HAVESAC("MultiInputPolicy", env, policy_kwargs=policy_kwargs, device=device, **settings)

    def synchronize(self) -> None:
        if self.cuda:
            th.cuda.synchronize()


# -- Losses and gradients


@contextmanager
def same_noise() -> Iterator[None]:
    """Draw actions with the same noise on every device, although each device has its own generator."""
    generator = th.Generator().manual_seed(0)

    def rsample(self: Normal, sample_shape: Any = ()) -> th.Tensor:
        noise = th.randn(self.loc.shape, generator=generator).to(self.loc.device)
        return self.loc + noise * self.scale

    with mock.patch.object(Normal, "rsample", rsample):
        yield


def update(model: HAVESAC, batch: DictReplayBufferSamples) -> tuple[dict[str, float], dict[str, th.Tensor]]:
    """Compute losses and gradients of one update on a given batch."""
    model.replay_buffer = StaticBatch(batch, model.device)  # type: ignore[assignment]
    with same_noise():
        model.train(1, len(batch.rewards))
    gradients = {
        name: parameter.grad.detach().cpu()
        for name, parameter in model.policy.named_parameters()
        if parameter.grad is not None
    }
    return losses_of(model), gradients


def check_losses(
    setting: Setting,
    tolerance: float,
    precision: str = "float32",
    tf32: bool = False,
    policy_kwargs: dict[str, Any] | None = None,
    **kwargs: Any,
) -> Result:
    """Compare losses and gradients of an update on the CPU in float32 and on the device."""
    # Use SGD, because Adam's first step is the sign of the gradient, even of rounding errors
    policy_kwargs = {"optimizer_class": th.optim.SGD, **(policy_kwargs or {})}
    reference = setting.model("cpu", policy_kwargs, **kwargs)
    model = setting.empty_model(None, {**policy_kwargs, "precision": precision}, **kwargs)
    model.set_logger(configure(None, []))
    model.policy.load_state_dict(reference.policy.state_dict())
    assert reference.replay_buffer is not None
    np.random.seed(0)
    batch = reference.replay_buffer.sample(setting.batch_size)
    assert isinstance(batch, DictReplayBufferSamples)
    expected = update(reference, batch)
    with exact_arithmetic():
        th.backends.cudnn.allow_tf32 = th.backends.cuda.matmul.allow_tf32 = tf32
        found = update(model, batch)
    if not (expected[0] and expected[0].keys() == found[0].keys()):
        return False, f"losses {sorted(expected[0])} and {sorted(found[0])}"
    loss, name = loss_difference(expected[0], found[0])
    gradient, worst = relative_difference(expected[1], found[1])
    ok = max(loss, gradient) < tolerance
    detail = f"losses differ by {loss:.1e} ({name}), gradients by {gradient:.1e} ({worst or 'none'}); {tolerance:g} may"
    return ok and len(expected[1]) > 0, detail


def check_adam(setting: Setting) -> Result:
    """Compare the optimizers, which are fused on a GPU, on the same gradients."""
    models = [setting.empty_model(device) for device in ("cpu", setting.device)]
    models[1].policy.load_state_dict(models[0].policy.state_dict())
    generator = th.Generator().manual_seed(0)
    for _ in range(5):
        for mine, theirs in zip(*(model.critic.parameters() for model in models), strict=True):
            mine.grad = th.randn(mine.shape, generator=generator)
            theirs.grad = mine.grad.to(theirs.device)
        for model in models:
            model.critic.optimizer.step()
    worst, name = relative_difference(*(parameters(model.critic) for model in models))
    fused = all(group["fused"] for group in models[1].critic.optimizer.param_groups)
    return fused and worst < 1e-5, f"parameters differ by {worst:.1e} ({name}) after 5 steps, fused: {fused}"


def check_bfloat16(setting: Setting) -> Result:
    """Check which precision "auto" selects, and its features."""
    plain = setting.model()
    auto = setting.empty_model(None, {"precision": "auto"})
    auto.policy.load_state_dict(plain.policy.state_dict())
    assert plain.replay_buffer is not None
    batch = plain.replay_buffer.sample(setting.batch_size)
    expected, features = (model.policy.encode(batch.observations) for model in (plain, auto))
    worst, _ = relative_difference({"features": expected}, {"features": features})
    native, dtype = has_native_bfloat16(th.device(setting.device).type), auto.critic.encoder.image_dtype(auto.device)
    ok = worst < 3e-2 and features.dtype == th.float32 and native == (dtype == th.bfloat16)
    if setting.cuda:
        ok &= dtype == th.bfloat16
    return ok, f"native {native}, auto takes {dtype}, features differ by {worst:.1e} and are {features.dtype}"


# -- Synchronisation


@contextmanager
def no_waiting(setting: Setting) -> Iterator[None]:
    """Raise an error wherever the host waits for the GPU."""
    if not setting.cuda:
        yield
        return
    th.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        th.cuda.set_sync_debug_mode("default")


def check_no_waiting(setting: Setting, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> Result:
    """Check that sampling and ``train`` do not wait for the GPU, and that the losses are finite."""
    model = setting.model(None, policy_kwargs, **kwargs)
    model.train(3, setting.batch_size)
    setting.synchronize()
    with no_waiting(setting):
        model.train(4, setting.batch_size)
    losses = losses_of(model)
    return bool(losses) and all(np.isfinite(list(losses.values()))), f"{losses}"


# -- The replay buffer


def batches(buffer: Any, batch_size: int, n_batches: int) -> list[DictReplayBufferSamples]:
    np.random.seed(1)
    return [buffer.sample(batch_size) for _ in range(n_batches)]


def check_replay(setting: Setting, storage: str, n_batches: int = 30) -> Result:
    """
    Check that batches equal those of SB3's buffer while many copies are in progress. The GPU is kept busy, so that
    memory that is overwritten too early would show.
    """
    env = make_env(TWO, setting.image_size, episode_length=7)
    arguments = (200, env.observation_space, env.action_space)
    reference = DictReplayBuffer(*arguments, device="cpu")  # type: ignore[arg-type]
    buffer = ModalityReplayBuffer(*arguments, device=setting.device, n_stack=3, storage=storage)
    for transition in transitions(env, 250):  # more than fit, so that some are overwritten
        reference.add(*transition)
        buffer.add(*transition)
    expected = batches(reference, setting.batch_size, n_batches)
    if setting.cuda:
        matrix = th.randn(8192, 8192, device=setting.device)
        for _ in range(20):
            matrix = matrix @ matrix * 1e-4
    with no_waiting(setting):
        found = batches(buffer, setting.batch_size, n_batches)
    on_device = all(
        tensor.device.type == th.device(setting.device).type for batch in found for tensor in tensors(batch)
    )
    equal = all(
        th.equal(a, b.cpu())
        for theirs, ours in zip(expected, found, strict=True)
        for a, b in zip(tensors(theirs), tensors(ours), strict=True)
    )
    frames = buffer.pool._blocks[0]["rgb"].device
    return equal and on_device, f"equal: {equal}, on the device: {on_device}, frames on {frames}"


# -- Files


def check_save_and_load(setting: Setting, source: str, target: str) -> Result:
    """Check that a model saved on one device and loaded on another has the same actions and continues training."""
    model = setting.model(source)
    model.train(3, setting.batch_size)
    assert model.env is not None
    env = make_env(TWO, setting.image_size, episode_length=25)
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model.zip")
        loaded = HAVESAC.load(Path(folder) / "model.zip", env=env, device=target)
        model.save_replay_buffer(Path(folder) / "buffer.pkl")
        loaded.load_replay_buffer(Path(folder) / "buffer.pkl")
    loaded.set_logger(configure(None, []))
    observation = model.env.reset()
    assert isinstance(observation, dict)
    with exact_arithmetic():
        actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
        worst = float(np.abs(actions[0] - actions[1]).max())
        loaded.train(2, setting.batch_size)
    devices = {tensor.device.type for tensor in loaded.policy.state_dict().values()}
    for optimizer in (loaded.actor.optimizer, loaded.critic.optimizer):
        states = optimizer.state.values()
        devices |= {value.device.type for state in states for value in state.values() if isinstance(value, th.Tensor)}
    steps = {int(state["step"]) for state in loaded.critic.optimizer.state.values()}
    ok = worst < 1e-4 and devices == {th.device(target).type} and steps == {5}
    return ok, f"actions differ by {worst:.1e}, parameters and optimizers on {sorted(devices)}, steps {sorted(steps)}"


def check_checkpoint(setting: Setting, target: str | None = None) -> Result:
    """Check that training continues from a checkpoint, and on the same device as without an interruption."""
    model = setting.empty_model()
    with tempfile.TemporaryDirectory() as folder, exact_arithmetic():
        model.learn(40)
        save_checkpoint(model, Path(folder) / "checkpoint-40")
        env = make_env(TWO, setting.image_size, episode_length=25)
        if target is not None:
            resumed = load_checkpoint(Path(folder) / "checkpoint-40", env, device=target)
            resumed.learn(20, reset_num_timesteps=False)
            losses = losses_of(resumed)
            ok = resumed.num_timesteps == 60 and bool(losses) and all(np.isfinite(list(losses.values())))
            return ok, f"goes on to step {resumed.num_timesteps} on {resumed.device}: {losses}"
        model.learn(20, reset_num_timesteps=False)
        resumed = load_checkpoint(Path(folder) / "checkpoint-40", env, device=setting.device)
        resumed.learn(20, reset_num_timesteps=False)
    worst, name = relative_difference(model.policy.state_dict(), resumed.policy.state_dict())
    same_bits = all(
        th.equal(a, b)
        for a, b in zip(model.policy.state_dict().values(), resumed.policy.state_dict().values(), strict=True)
    )
    ok = resumed.num_timesteps == 60 and worst < (1e-2 if setting.cuda else 1e-12)
    return ok, f"bit for bit: {same_bits}, parameters differ by {worst:.1e} ({name or 'none'}) 20 steps later"


# -- The whole


def check_learn(setting: Setting) -> Result:
    """Check ``learn`` with logging, in the default precision."""
    model = setting.empty_model(None, {"precision": "auto"}, replay_buffer_kwargs={"storage": "device"})
    model.learn(80, log_interval=1)
    losses = losses_of(model)
    assert isinstance(model._last_obs, dict)
    model.predict(model._last_obs)
    return model._n_updates > 0 and all(np.isfinite(list(losses.values()))), f"{model._n_updates} updates, {losses}"


def check_graph(setting: Setting, **kwargs: Any) -> Result:
    """Check that the recorded update equals the eager one."""
    tolerance = 2e-2 if setting.cuda else 1e-4
    losses, parameters = difference(setting.device, setting.image_size, setting.batch_size, **kwargs)
    ok = max(losses, parameters) < tolerance
    return ok, f"losses differ by {losses:.1e}, parameters by {parameters:.1e}; {tolerance:g} may"


def check_graph_no_waiting(setting: Setting) -> Result:
    """Check that neither sampling nor launching the graph makes the host wait."""
    step = GraphedUpdate(setting.model(), setting.batch_size)
    for _ in range(step.warm_up + 2):
        step()
    setting.synchronize()
    with no_waiting(setting):
        for _ in range(5):
            step()
    losses = losses_of(step.model)
    return all(np.isfinite(list(losses.values()))), f"{len(step.graphs)} graph(s), {losses}"


def check_compile(setting: Setting) -> Result:
    """Check that compiled modules compute the same losses and gradients."""
    models = [setting.model(compile=compiled) for compiled in (False, True)]
    assert models[0].replay_buffer is not None
    batch = models[0].replay_buffer.sample(setting.batch_size)
    assert isinstance(batch, DictReplayBufferSamples)
    with exact_arithmetic():
        expected, found = (update(model, batch) for model in models)
    loss, _ = loss_difference(expected[0], found[0])
    gradient, _ = relative_difference(expected[1], found[1])
    return max(loss, gradient) < 1e-3, f"losses differ by {loss:.1e}, gradients by {gradient:.1e}"


def checks(setting: Setting) -> dict[str, Check]:
    """List the checks by name, the most important ones first."""
    paper: dict[str, Any] = {"target": "paper", "refusion": "free", "local_coef": 0.0}
    device = setting.device
    return {
        "losses": partial(check_losses, tolerance=1e-3),
        "no waiting": check_no_waiting,
        "no waiting, storage=device": partial(check_no_waiting, replay_buffer_kwargs={"storage": "device"}),
        "replay memory, pinned": partial(check_replay, storage="memory"),
        "replay device": partial(check_replay, storage="device"),
        "save here, load on cpu": partial(check_save_and_load, source=device, target="cpu"),
        "save on cpu, load here": partial(check_save_and_load, source="cpu", target=device),
        "checkpoint": check_checkpoint,
        "checkpoint, on cpu": partial(check_checkpoint, target="cpu"),
        "bfloat16": check_bfloat16,
        "losses bfloat16": partial(check_losses, tolerance=0.4, precision="bfloat16"),
        "losses tf32": partial(check_losses, tolerance=5e-2, tf32=True),
        "adam": check_adam,
        "learn": check_learn,
        "graph": check_graph,
        "graph, no waiting": check_graph_no_waiting,
        "graph, delays": partial(check_graph, updates=24, policy_delay=2, target_update_interval=3),
        "graph, dropout and shift": partial(check_graph, modality_dropout=0.3, random_shift=4),
        "graph, storage=device": partial(check_graph, replay_buffer_kwargs={"storage": "device"}),
        "losses paper": partial(check_losses, tolerance=5e-3, **paper),
        "losses monotone": partial(check_losses, tolerance=1e-3, refusion="monotone"),
        "losses lve": partial(check_losses, tolerance=1e-3, value_estimation="lve"),
        "losses gve": partial(check_losses, tolerance=1e-3, value_estimation="gve", auxiliary=None),
        "losses n-step": partial(check_losses, tolerance=1e-3, n_steps=3),
        "losses transfuser": partial(check_losses, tolerance=1e-3, policy_kwargs={"fusion": "transfuser"}),
        "losses efnet": partial(check_losses, tolerance=1e-3, policy_kwargs={"fusion": "efnet"}),
        "no waiting, dropout and delay": partial(check_no_waiting, modality_dropout=0.3, policy_delay=2),
        "no waiting, shift": partial(check_no_waiting, random_shift=4, n_augmentations=2),
        "no waiting, paper and n-step": partial(check_no_waiting, n_steps=3, **paper),
        "replay mmap": partial(check_replay, storage="mmap"),
        "compile": check_compile,
    }


def run(names: Sequence[str], setting: Setting, output: Path) -> int:
    """
    Run checks and write their rows.

    :param names: Names of the checks
    :param setting: Settings
    :param output: CSV file
    :return: Number of failed checks
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    known, failed = checks(setting), 0
    with output.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for name in names:
            start = time.perf_counter()
            try:
                ok, detail = known[name](setting)
            except Exception as error:
                traceback.print_exc()
                ok, detail = False, f"{type(error).__name__}: {error}"
            failed += not ok
            row = {"check": name, "ok": ok, "detail": detail, "device": setting.device}
            writer.writerow({**row, "seconds": round(time.perf_counter() - start, 1)})
            file.flush()
            print(f"{'ok  ' if ok else 'FAIL'} {name}: {detail}", flush=True)
    return failed


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--only", nargs="+", default=[""], help="parts of the names of checks")
    parser.add_argument("--skip", nargs="+", default=[], help="parts of the names of checks")
    parser.add_argument("--output", type=Path, default=RESULTS / "gpu" / "correctness.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    print(*machine(args.device).values(), sep="\n", flush=True)
    setting = Setting(args.device, args.image_size, args.batch_size)
    names = [name for name in checks(setting) if any(part in name for part in args.only)]
    names = [name for name in names if not any(part in name for part in args.skip)]
    failed = run(names, setting, args.output)
    print(f"{len(names) - failed} of {len(names)} checks hold", flush=True)
    if setting.cuda:
        print(f"at most {th.cuda.max_memory_allocated() / 2**20:.0f} MiB of the GPU's memory", flush=True)
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
