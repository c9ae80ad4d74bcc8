"""
Latency of one action in onnxruntime and in PyTorch, and the sizes of the files.

    OMP_NUM_THREADS=1 python -m benchmarks.export_speed

The policy is HAVESAC's with its defaults and untrained weights, on three frames of rgb and event images with 64 pixels,
a batch of one and one thread. The contenders take turns in one process with the same observation. These rows are
printed and written to benchmarks/results/export_speed.csv:

- ``predict``: the model, with image encoders in float32 and, if the processor supports it, bfloat16;
- ``predict, loaded``: the policy read by ``load_policy``, in float32;
- ``onnxruntime``: the action from the file of ``export_onnx``; ``onnxruntime, with weights``: with modality weights.

Columns: median and quartiles of the wall-clock time of a call; ``cpu_ms``, the median processor time, which is more
reliable on a busy machine; ``vs_predict``, the speed relative to ``predict`` in float32 (the median over the rounds of
the ratio of processor times in a round); ``size_mb``, the size of what has to be deployed: SB3's zip (untrained, so
without the state of the optimizers), the folder, or the file.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnxruntime
import torch as th

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from benchmarks.random_sensors import CHANNELS, make_env
from sb3_have import HAVESAC
from sb3_have.common.encoders import has_native_bfloat16
from sb3_have.export import export_onnx, export_safetensors, load_policy

MODALITIES = ("rgb", "event")
COLUMNS = ("contender", "precision", "median_ms", "q25_ms", "q75_ms", "cpu_ms", "vs_predict", "size_mb")
Contender = tuple[str, str]
BASELINE: Contender = ("predict", "float32")


def size_mb(path: Path) -> float:
    """Return the size of a file or of the files in a folder."""
    files = path.iterdir() if path.is_dir() else [path]
    return round(sum(file.stat().st_size for file in files) / 1e6, 3)


def measure(args: argparse.Namespace, folder: Path) -> list[Row]:
    """Return the rows of all contenders; ``folder`` is for their files."""
    env = make_env({name: CHANNELS[name] for name in MODALITIES}, args.image_size, args.n_stack)
    models = {
        precision: HAVESAC(
            "MultiInputPolicy", env, buffer_size=1, seed=0, device="cpu", policy_kwargs={"precision": precision}
        )
        for precision in ("float32", "bfloat16")[: 2 if has_native_bfloat16("cpu") else 1]
    }
    model = models["float32"]
    model.save(folder / "model.zip")
    export_safetensors(model, folder / "policy")
    export_onnx(model, folder / "policy.onnx")
    policy = load_policy(folder / "policy", "cpu")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(folder / "policy.onnx", options, providers=["CPUExecutionProvider"])
    observation = env.reset()
    assert isinstance(observation, dict)
    action, _ = model.predict(observation, deterministic=True)
    assert np.allclose(session.run(["action"], observation)[0], action, atol=1e-4)

    calls: dict[Contender, Callable[[], object]] = {
        ("predict", precision): lambda model=model: model.predict(observation, deterministic=True)  # type: ignore[misc]
        for precision, model in models.items()
    }
    calls["predict, loaded", "float32"] = lambda: policy.predict(observation, deterministic=True)
    calls["onnxruntime", "float32"] = lambda: session.run(["action"], observation)
    calls["onnxruntime, with weights", "float32"] = lambda: session.run(["action", "weights"], observation)
    files = {"predict": "model.zip", "predict, loaded": "policy", "onnxruntime": "policy.onnx"}

    times, where, rows = interleave(calls, args.rounds, args.repeats), machine(), []
    for (name, precision), (wall, cpu) in times.items():
        row: Row = {"contender": name, "precision": precision, "image_size": args.image_size, "n_stack": args.n_stack}
        row |= {"modalities": "+".join(MODALITIES), "batch_size": 1, "threads": 1, **quartiles(wall)}
        row |= {"cpu_ms": round(float(np.median(cpu)), 3)}
        row |= {"vs_predict": round(median_ratio(times[BASELINE].cpu, cpu), 2)}
        row |= {"size_mb": size_mb(folder / files[name]) if name in files else ""}
        rows.append({**row, "rounds": args.rounds, "repeats": args.repeats, **where})
        rows[-1]["versions"] += f", onnxruntime {version('onnxruntime')}, safetensors {version('safetensors')}"
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image-size", type=int, default=64)
    parser.add_argument("--n-stack", type=int, default=3, help="frames")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3, help="calls of each contender per round")
    parser.add_argument("--out", type=Path, default=RESULTS / "export_speed.csv")
    args = parser.parse_args()
    th.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(args, Path(folder))
    save(rows, args.out, ("image_size", "n_stack"))
    show(rows, COLUMNS)
    print(rows[0]["machine"], rows[0]["versions"], sep="\n")


if __name__ == "__main__":
    main()
