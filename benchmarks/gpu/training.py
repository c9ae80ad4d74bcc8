"""Train in parallel on one GPU, with a processor core per run, for a limited time.

    python -m benchmarks.gpu.training --seconds 150 --output training.csv
    python -m benchmarks.gpu.training --device cpu --seconds 60 --configs have --seeds 0     # tries the script

Every run is a process ``python -m sb3_have.train`` with its own folder in ``--runs``, and continues from the newest
checkpoint in it. When a run ends, the script writes a row with its steps, seconds, steps per second, episodes, and mean
distance and return of the last ten episodes; there are no evaluations. The curves of all runs (``monitor.csv``,
``progress.csv``) are packed into ``curves.tar.gz`` next to the rows. Checkpoints, which include the replay buffer, stay
in their folders.
"""

from __future__ import annotations

import argparse
import io
import os
import subprocess
import sys
import tarfile
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks.measure import RESULTS, Row, machine, save, show
from sb3_have.checkpoint.checkpoint import checkpoint_info, checkpoints

CONFIGS = ("have", "lve", "gve", "rgb", "event")
LAST_EPISODES = 10
# Seconds until a process starts to train
START = 20
# Seconds that it may take to write all checkpoints at once
SAVE = 30


def start(folder: Path, config: str, seed: int, core: int, seconds: float, device: str) -> subprocess.Popen[bytes]:
    """Start a training process that writes its output to ``log.txt`` in its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "sb3_have.train", "--config", config, "--seed", str(seed), "--out", str(folder)]
    command += ["--device", device, "--time-limit", str(seconds), "--eval-freq", "0", "--save-freq", "1000000"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with (folder / "log.txt").open("ab") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
    os.sched_setaffinity(process.pid, {core})
    return process


def result(folder: Path, exit_code: int | None) -> Row:
    """Read the progress of a run."""
    newest = max((checkpoint_info(path) for path in checkpoints(folder)), key=lambda info: info["steps"], default=None)
    row: Row = {"exit_code": exit_code, "steps": None, "seconds": None, "steps_per_s": None}
    if newest is not None:
        seconds = newest["info"]["seconds"]
        row |= {"steps": newest["steps"], "seconds": round(seconds, 1)}
        row["steps_per_s"] = round(newest["steps"] / seconds, 1) if seconds > 0 else None
    row |= {"episodes": 0, "distance": None, "return": None}
    file = folder / "monitor.csv"
    lines = file.read_text().splitlines(keepends=True)[1:] if file.exists() else []
    if len(lines) > 1:
        episodes = pd.read_csv(io.StringIO("".join(lines)))
        last = episodes.tail(LAST_EPISODES)
        row |= {"episodes": len(episodes), "return": round(float(last["r"].mean()), 2)}
        row["distance"] = round(float(last["distance"].mean()), 1) if "distance" in last else None
    if exit_code != 0:
        log = folder / "log.txt"
        output = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
        row["error"] = output[-1] if output else f"exit code {exit_code}"
    return row


def train(
    configs: Sequence[str], seeds: Sequence[int], runs: Path, seconds: float, device: str, output: Path
) -> list[Row]:
    """
    Make all runs at once and write their rows.

    :param configs: Names of configurations in ``zoo_configs``
    :param seeds: Seeds for each configuration
    :param runs: Folder for the folders of the runs
    :param seconds: Total time; a process that is still running then is killed
    :param device: Device of the models
    :param output: CSV file of the rows
    :return: The rows
    """
    deadline = time.monotonic() + seconds
    cores = sorted(os.sched_getaffinity(0))
    about = machine(device)
    started: dict[tuple[str, int], subprocess.Popen[bytes]] = {}
    for index, (config, seed) in enumerate((config, seed) for seed in seeds for config in configs):
        core = cores[index % len(cores)]
        limit = max(seconds - START - SAVE, 5)
        started[config, seed] = start(runs / f"{config}-{seed}", config, seed, core, limit, device)
    rows: list[Row] = []

    def finish(config: str, seed: int, exit_code: int | None) -> None:
        folder = runs / f"{config}-{seed}"
        row = {"device": device, "config": config, "seed": seed, "processes": len(started), **result(folder, exit_code)}
        rows.append(row)
        save([{"error": None, **row, **about}], output, ("device", "config", "seed"))

    running = dict(started)
    try:
        while running and time.monotonic() < deadline:
            for (config, seed), process in list(running.items()):
                if process.poll() is not None:
                    del running[config, seed]
                    finish(config, seed, process.returncode)
            time.sleep(0.2)
    finally:
        for process in running.values():
            process.kill()
        for (config, seed), process in running.items():
            process.wait()
            finish(config, seed, process.returncode)
        pack(runs, output.parent / "curves.tar.gz")
    return rows


def pack(runs: Path, archive: Path) -> None:
    """Pack the curves and logs of all runs."""
    with tarfile.open(archive, "w:gz") as packed:
        for path in sorted(runs.rglob("*")):
            if path.is_file() and path.suffix in (".csv", ".txt"):
                packed.add(path, path.relative_to(runs))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=150, help="total time")
    parser.add_argument("--configs", nargs="+", default=list(CONFIGS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--runs", type=Path, default=Path("runs") / "gpu")
    parser.add_argument("--output", type=Path, default=RESULTS / "gpu" / "training.csv")
    args = parser.parse_args(arguments)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows = train(args.configs, args.seeds, args.runs, args.seconds, args.device, args.output)
    show(rows, [column for column in rows[0] if column != "device"])
    sys.exit(any(row["exit_code"] != 0 for row in rows))


if __name__ == "__main__":
    main()
