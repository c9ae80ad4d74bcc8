"""Draw the figures of docs/method.md: the structure of HAVE, and how well it learns values that are known exactly.

    OMP_NUM_THREADS=1 python -m benchmarks.docs_figures                    # docs/figures/*.png, takes minutes
    python -m benchmarks.docs_figures --figures structure.png              # without training

The figures show a few seeds on :class:`benchmarks.known_q.SensorRing`; ``benchmarks/STUDY.md`` has eight of each form.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from benchmarks.known_q import FORMS, Floats, Samples, evaluate, make_model, sample

BLUE, ORANGE, GREEN, PINK, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
# Label and colour of forms of benchmarks.known_q
CURVES: Mapping[str, tuple[str, str]] = {
    "have": ("HAVE, the default", BLUE),
    "have-unsupervised": ("local_coef=0", GREEN),
    "have-paper": ('target="paper", refusion="free", local_coef=0', ORANGE),
}
SEEDS = (0, 1, 2)
N_UPDATES = 1200
# Updates between two points of a curve
EVERY = 100


class Learned(NamedTuple):
    """
    A trained form, evaluated on fresh samples.

    :param samples: The samples
    :param errors: Error before training and after every ``EVERY`` updates, in standard deviations of the exact Q
    :param q: (B,), the Q-value used by the actor and the target, mean of the twins
    :param weights: (B, d), weights of the modalities
    """

    samples: Samples
    errors: list[float]
    q: Floats
    weights: Floats


@cache
def learn(form: str, seed: int, n_updates: int = N_UPDATES) -> Learned:
    """
    Train a form and evaluate it.

    :param form: One of ``FORMS``
    :param seed: Seed of networks, transitions, minibatches and samples
    :param n_updates: Total number of updates
    """
    model = make_model(seed, **FORMS[form])
    samples = sample(seed=seed)
    errors = [evaluate(model, samples)["error"]]
    for _ in range(n_updates // EVERY):
        model.train(EVERY, batch_size=128)
        errors.append(evaluate(model, samples)["error"])
    with th.no_grad():
        parts = model.critic.decompose(samples.observations, samples.actions)
    return Learned(samples, errors, parts["q"].mean(dim=0).double().numpy(), parts["weights"].double().numpy())


def structure() -> Figure:
    """Draw the flow of information from the sensors to the Q-value."""
    figure = Figure(figsize=(9.0, 4.9), layout="constrained")
    axis = figure.subplots()
    axis.set(xlim=(0, 100), ylim=(0, 54))
    axis.axis("off")
    for index, (y, name) in enumerate([(48, "rgb"), (37, "event"), (26, "depth")], start=1):
        box(axis, (7, y), name, GREY, width=11)
        box(axis, (23, y), f"encoder\n$z_{index}$", BLUE)
        box(axis, (49, y), f"local critic\n$q_{index}(z_{index},\\,a)$", GREEN, width=17)
        arrow(axis, (12.5, y), (17, y))
        arrow(axis, (29, y), (40.5, y))
        arrow(axis, (57.5, y), (66, 37 + (y - 37) * 0.25))
        branch(axis, (34, y))
    line(axis, (34, 48), (34, 16))
    arrow(axis, (34, 17), (34, 15))
    box(axis, (34, 11.5), "fused $z_g = (z_1, z_2, z_3)$", BLUE, width=24)
    box(axis, (9, 11.5), "actor $\\pi(a|z_g)$\nfeatures detached", PINK, width=16)
    arrow(axis, (22, 11.5), (17, 11.5), style="dashed")
    arrow(axis, (46, 11.5), (49, 11.5))
    box(axis, (57.5, 11.5), "attention\n$w_i$, sum 1 (Eq. 9)", ORANGE, width=17)
    arrow(axis, (61, 15), (70, 33.5))
    box(axis, (74, 37), "$q_l = \\sum_i w_i\\,q_i$", GREEN, width=16)
    line(axis, (34, 8), (34, 3))
    line(axis, (34, 3), (94, 3))
    branch(axis, (76, 3))
    arrow(axis, (76, 3), (76, 8))
    box(axis, (76, 11.5), "global critic\n$q_g(z_g,\\,a)$", BLUE, width=15)
    arrow(axis, (94, 3), (94, 20.5))
    box(axis, (92, 24), "re-fusion\n$b_g q_g + b_l q_l$", ORANGE, width=15)
    arrow(axis, (82, 36), (89, 27.5))
    arrow(axis, (80, 15), (88, 20.5))
    arrow(axis, (92, 27.5), (92, 44.5))
    box(axis, (92, 48), "value $q$", PINK, width=12)
    return figure


def box(axis: Axes, centre: tuple[float, float], text: str, colour: str, width: float = 12, height: float = 7) -> None:
    corner = (centre[0] - width / 2, centre[1] - height / 2)
    for alpha, edge in [(0.16, "none"), (1.0, colour)]:
        axis.add_patch(
            FancyBboxPatch(
                corner, width, height, boxstyle="round,pad=0,rounding_size=1", fc=colour if edge == "none" else "none",
                ec=edge, alpha=alpha,
            )
        )  # fmt: skip
    axis.text(*centre, text, ha="center", va="center", fontsize=9)


def arrow(axis: Axes, start: tuple[float, float], end: tuple[float, float], style: str = "solid") -> None:
    shape = {"arrowstyle": "-|>", "color": GREY, "linestyle": style, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", end, start, arrowprops=shape)


def line(axis: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axis.plot(*zip(start, end, strict=True), color=GREY, lw=1)


def branch(axis: Axes, point: tuple[float, float]) -> None:
    """Mark a point where lines are connected; lines without a mark only cross."""
    axis.plot(*point, "o", color=GREY, markersize=4.5)


def values(seeds: Sequence[int] = SEEDS, n_updates: int = N_UPDATES) -> Figure:
    """Plot the default form against the exact Q, and the error of three forms during training."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    learnt = learn("have", seeds[0], n_updates)
    exact = learnt.samples.q
    ends = [min(exact.min(), learnt.q.min()), max(exact.max(), learnt.q.max())]
    left.plot(ends, ends, color=GREY, lw=1)
    left.plot(exact, learnt.q, ".", color=BLUE, markersize=2, alpha=0.4)
    left.set(
        xlabel="exact soft Q", ylabel="learnt", title=f"HAVE, the default: seed {seeds[0]}, {n_updates:,} updates",
        aspect="equal",
    )  # fmt: skip
    updates = np.arange(n_updates // EVERY + 1) * EVERY
    for form, (label, colour) in CURVES.items():
        for seed in seeds:
            errors = learn(form, seed, n_updates).errors
            right.semilogy(updates, errors, color=colour, lw=1.2, label=label if seed == seeds[0] else None)
    right.set(
        xlabel="update",
        ylabel="error / standard deviation of Q",
        title=f"error of {len(seeds)} seeds each",
        ylim=(0.08, 8e3),
    )
    right.legend(fontsize=8, loc="upper left")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    return figure


def weights(seeds: Sequence[int] = SEEDS, n_updates: int = N_UPDATES) -> Figure:
    """Plot the weights of reliable and failed sensors, with and without supervision of the local critics."""
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    titles = {"have": "every critic regressed on the target", "have-unsupervised": "the mixture alone (local_coef=0)"}
    for axis, (form, title) in zip(axes, titles.items(), strict=True):
        learnt = [learn(form, seed, n_updates) for seed in seeds]
        left_weight = np.concatenate([result.weights[:, 0] for result in learnt])
        reliable = np.concatenate([result.samples.reliable for result in learnt])
        cases = [
            ("right fails", reliable[:, 0] & ~reliable[:, 1], BLUE),
            ("both sound", reliable.all(axis=1), GREY),
            ("left fails", ~reliable[:, 0], ORANGE),
        ]
        for label, chosen, colour in cases:
            shares = np.full(chosen.sum(), 1 / chosen.sum())
            axis.hist(left_weight[chosen], np.linspace(0, 1, 41), weights=shares, color=colour, alpha=0.6, label=label)
        axis.set(xlabel="weight of the left sensor", title=title, xlim=(0, 1))
    axes[0].set_ylabel("share of the samples")
    axes[0].legend(fontsize=8)
    return figure


FIGURES: Mapping[str, Callable[[], Figure]] = {"structure.png": structure, "values.png": values, "weights.png": weights}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", nargs="+", choices=list(FIGURES), default=list(FIGURES))
    parser.add_argument("--out", type=Path, default=Path("docs/figures"), help="output folder")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.figures:
        FIGURES[name]().savefig(args.out / name, dpi=130)
        print(f"wrote {args.out / name}")


if __name__ == "__main__":
    main()
