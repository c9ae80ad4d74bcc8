"""How well HAVESAC learned to drive: evaluates the runs of ``sb3_have.train`` and draws their training.

    for seed in 0 1 2; do for precision in float32 bfloat16; do
        OMP_NUM_THREADS=1 python -m sb3_have.train --config havesac --seed $seed --steps 10000 \\
            --hyperparams "policy_kwargs:{precision: $precision}" --out runs/$precision-$seed
    done; done
    python -m benchmarks.learning runs/float32-* runs/bfloat16-*

Copies each run's training episodes to ``benchmarks/results/learning/monitor-<run>.csv``, evaluates its model in the
eight weathers (``evaluation.csv`` beside it) and draws ``docs/learning.png``, one colour for the seeds of a kind (the
name of a run without its number). Without runs, it only draws.
"""

import argparse
from pathlib import Path

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sb3_have import HAVESAC, evaluate
from sb3_have.envs.weather import WEATHERS
from sb3_have.train import evaluation_env_kwargs, load_config

RESULTS = Path(__file__).parent / "results"
LEARNING = RESULTS / "learning"
ENV_ID = "HighwayVision-v0"
DRIVERS = {
    "random": "random",
    "straight at 25 m/s": "keep_straight_25",
    "straight at 20 m/s": "keep_straight_20",
    "IDM/MOBIL": "idm_mobil",
}


def evaluate_runs(runs: list[Path], episodes: int) -> None:
    """Evaluate the final model of each run, and keep its training episodes."""
    LEARNING.mkdir(parents=True, exist_ok=True)
    for old in LEARNING.glob("monitor-*.csv"):
        old.unlink()
    env_kwargs = evaluation_env_kwargs(load_config("havesac", ENV_ID))
    frames = []
    for run in runs:
        model = HAVESAC.load(run / "model.zip")
        frame = evaluate(model, ENV_ID, WEATHERS, episodes, env_kwargs=env_kwargs, progress_bar=True)
        frame.insert(0, "run", run.name)
        frame.insert(1, "step", model.num_timesteps)
        frames.append(frame)
        (LEARNING / f"monitor-{run.name}.csv").write_text((run / "monitor.csv").read_text())
        pd.concat(frames).round(3).to_csv(LEARNING / "evaluation.csv", index=False)
        print(
            f"{run.name}, {model.num_timesteps} steps: distance {frame['distance_mean'].mean():.0f} m, "
            f"return {frame['return_mean'].mean():.1f}, crashes {frame['crash_share'].mean():.0%}, "
            f"off the road {frame['offroad_share'].mean():.0%}, {episodes * len(WEATHERS)} episodes",
            flush=True,
        )


def draw(out: Path, window: int = 20) -> None:
    """Distance of the training episodes, a running mean over ``window`` of them, beside other drivers."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    colours: dict[str, str] = {}
    for file in sorted(LEARNING.glob("monitor-*.csv")):
        kind = file.stem.removeprefix("monitor-").rpartition("-")[0]
        label = None if kind in colours else f"HAVESAC {kind}"
        colour = colours.setdefault(kind, f"C{len(colours)}")
        episodes = pd.read_csv(file, skiprows=1)
        steps, distance = episodes["l"].cumsum(), episodes["distance"].rolling(window, min_periods=1).mean()
        axes.plot(steps, distance, colour, label=label)
    table = pd.read_csv(RESULTS / "state_learnability.csv").drop_duplicates("setting", keep="last")
    levels = dict(zip(table["setting"], table["distance_mean"].astype(float), strict=True))
    for (name, setting), style in zip(DRIVERS.items(), (":", "--", "-.", "-"), strict=True):
        axes.axhline(levels[setting], color="grey", linestyle=style, linewidth=1, label=name)
    axes.set(
        xlabel="environment steps in finished episodes",
        ylabel=f"distance [m], mean of {window} episodes",
        ylim=(0, None),
    )
    axes.legend(fontsize="small", ncols=2)
    figure.savefig(out, dpi=100)
    print(f"wrote {out}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--episodes", type=int, default=2, help="per weather")
    parser.add_argument("--picture", type=Path, default=Path("docs/learning.png"))
    args = parser.parse_args()
    if args.runs:
        evaluate_runs(args.runs, args.episodes)
    draw(args.picture)


if __name__ == "__main__":
    main()
