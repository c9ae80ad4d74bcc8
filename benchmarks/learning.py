"""Collect runs of ``sb3_have.train`` and plot how well HAVESAC learns to drive.

    for seed in 0 1 2; do for precision in float32 bfloat16; do
        OMP_NUM_THREADS=1 python -m sb3_have.train --config have-50k --seed $seed --steps 10000 \\
            --eval-freq 2500 --eval-episodes 1 --hyperparams "policy_kwargs:{precision: $precision}" \\
            --out runs/$precision-$seed
    done; done
    python -m benchmarks.learning runs/float32-* runs/bfloat16-*

Copies each run's training episodes to ``benchmarks/results/learning/monitor-<run>.csv`` and its evaluations to
``evaluation.csv`` in the same folder, and draws ``docs/learning.png``, with one colour for all seeds of a kind (the
name of a run without its number). Without runs, it only draws.
"""

import argparse
from pathlib import Path

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

RESULTS = Path(__file__).parent / "results"
LEARNING = RESULTS / "learning"
DRIVERS = {
    "random": "random",
    "straight at 25 m/s": "keep_straight_25",
    "straight at 20 m/s": "keep_straight_20",
    "IDM/MOBIL": "idm_mobil",
}


def gather(runs: list[Path]) -> None:
    """Copy the records of the runs, replacing earlier ones."""
    LEARNING.mkdir(parents=True, exist_ok=True)
    for old in LEARNING.glob("monitor-*.csv"):
        old.unlink()
    frames = []
    for run in runs:
        (LEARNING / f"monitor-{run.name}.csv").write_text((run / "monitor.csv").read_text())
        frame = pd.read_csv(run / "evaluation.csv").drop(columns="wall_time").round(3)
        frame.insert(0, "run", run.name)
        frames.append(frame)
    pd.concat(frames).to_csv(LEARNING / "evaluation.csv", index=False)


def evaluations() -> pd.DataFrame:
    """Load the evaluations, one row per run and step, averaged over the weathers."""
    table = pd.read_csv(LEARNING / "evaluation.csv")
    columns = ["distance_mean", "return_mean", "crash_share", "offroad_share"]
    return table.groupby(["run", "step"], sort=False)[columns].mean().reset_index()


def kind(run: str) -> str:
    return run.rpartition("-")[0]


def draw(out: Path, window: int = 20) -> None:
    """Plot the distance in training (mean of ``window`` episodes) and in evaluations, with other drivers as levels."""
    figure = Figure(figsize=(10, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    training, evaluated = figure.subplots(1, 2, sharey=True)
    files = sorted(LEARNING.glob("monitor-*.csv"))
    names = [file.stem.removeprefix("monitor-") for file in files]
    colours = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(map(kind, names)))}
    for file, name in zip(files, names, strict=True):
        episodes = pd.read_csv(file, skiprows=1)
        distance = episodes["distance"].rolling(window, min_periods=1).mean()
        training.plot(episodes["l"].cumsum(), distance, colours[kind(name)], linewidth=1)
    table = evaluations()
    for run, rows in table.groupby("run"):
        evaluated.plot(rows["step"], rows["distance_mean"], colours[kind(str(run))], linewidth=1, marker=".")
    for group, rows in table.groupby(table["run"].map(kind)):
        means = rows.groupby("step")["distance_mean"].mean()
        label = f"HAVESAC {group}, mean of the seeds"
        evaluated.plot(means.index, means, colours[str(group)], linewidth=3, label=label)
    for axes in (training, evaluated):
        draw_drivers(axes)
    training.set(xlabel="environment steps in finished episodes", ylabel="distance [m]", ylim=(0, None))
    training.set_title(f"training, mean of {window} episodes")
    evaluated.set(xlabel="environment steps", title="evaluation, an episode in each weather")
    figure.legend(*evaluated.get_legend_handles_labels(), fontsize="small", ncols=3, loc="outside lower center")
    figure.savefig(out, dpi=100)
    print(f"wrote {out}")


def draw_drivers(axes: Axes) -> None:
    table = pd.read_csv(RESULTS / "state_learnability.csv").drop_duplicates("setting", keep="last")
    levels = dict(zip(table["setting"], table["distance_mean"].astype(float), strict=True))
    for (name, setting), style in zip(DRIVERS.items(), (":", "--", "-.", "-"), strict=True):
        axes.axhline(levels[setting], color="grey", linestyle=style, linewidth=1, label=name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--picture", type=Path, default=Path("docs/learning.png"))
    args = parser.parse_args()
    if args.runs:
        gather(args.runs)
    print(evaluations().round(2).to_string(index=False))
    draw(args.picture)


if __name__ == "__main__":
    main()
