"""How re-fusion answers to the values it mixes: H over (q_g, q_l) at one observation, and the sign of its slopes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from sb3_have.plotting.style import MEDIUM


class Response(NamedTuple):
    """H(q_g, q_l) on a grid of G global and L local values."""

    q_global: np.ndarray
    """(G,)."""
    q_lve: np.ndarray
    """(L,)."""
    h: np.ndarray
    """(L, G): a row for each local value."""
    slope_global: np.ndarray
    """(L, G): dH/dq_g."""
    slope_lve: np.ndarray
    """(L, G): dH/dq_l."""
    actual: tuple[float, float]
    """q_g and q_l at the observation and the action that the policy prefers there, mean of the twins."""
    refusion: str
    """Form of H."""


def refusion_response(
    model: Any,
    observation: Any,
    q_global: ArrayLike | None = None,
    q_lve: ArrayLike | None = None,
    points: int = 61,
) -> Response:
    """What re-fusion would make of other values at an observation; slopes are exact.

    :param model: a :class:`~sb3_have.HAVESAC` with ``value_estimation="have"``
    :param observation: one observation, as for ``predict``
    :param q_global: (G,) values to try; by default about the actual ones, as wide as their difference and at least
        ten either way
    :param q_lve: (L,) likewise
    :param points: of a grid that is not given
    :raises ValueError: if the model has no re-fusion, or the observation is a batch of several
    """
    critic = model.critic
    if getattr(critic, "refusion", None) is None:
        estimation = getattr(critic, "value_estimation", None)
        raise ValueError(f'value_estimation={estimation!r} has no re-fusion: train with "have"')
    action, _ = model.predict(observation, deterministic=True)  # also switches to evaluation mode
    tensors, _ = model.policy.obs_to_tensor(observation)
    scaled = np.reshape(model.policy.scale_action(action), (-1, int(np.prod(model.action_space.shape))))
    if len(scaled) != 1:
        raise ValueError(f"observation: expected one, got a batch of {len(scaled)}")
    with th.no_grad():
        features = critic.encoder(tensors)
        values = critic.values(features, th.as_tensor(scaled, dtype=th.float32, device=model.device))
        actual = float(values.q_global.mean()), float(values.q_lve.mean())
    reach = max(10.0, abs(actual[0] - actual[1]))
    grids = []
    for given, centre in zip((q_global, q_lve), actual, strict=True):
        grids.append(np.linspace(centre - reach, centre + reach, points) if given is None else np.asarray(given, float))
    mesh = np.meshgrid(*grids)  # (L, G) each
    inputs = [th.tensor(axis.ravel()[None], dtype=features.dtype, device=model.device) for axis in mesh]
    inputs = [tensor.requires_grad_() for tensor in inputs]
    h = critic.refusion(*inputs, features.expand(mesh[0].size, -1, -1))  # (1, L * G)
    slope_global, slope_lve = th.autograd.grad(h.sum(), inputs)
    parts = [part.detach().cpu().numpy().reshape(mesh[0].shape) for part in (h, slope_global, slope_lve)]
    return Response(grids[0], grids[1], parts[0], parts[1], parts[2], actual, str(critic.refusion.refusion))


def plot_refusion(response: Response) -> Figure:
    """H as a landscape, and its slopes in q_g and q_l: hatched where they are negative.

    :param response: from :func:`refusion_response`
    """
    figure = Figure(figsize=(11.0, 3.7), layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    filled = axes[0].contourf(response.q_global, response.q_lve, response.h, levels=16, cmap="cividis")
    lines = axes[0].contour(
        *(response.q_global, response.q_lve, response.h),
        levels=filled.levels[::2],  # every second of those that are filled
        colors="white",
        linewidths=0.7,
        negative_linestyles="solid",
    )
    figure.colorbar(filled, ax=axes[0]).add_lines(lines)
    axes[0].set_title("H", fontsize=MEDIUM)
    # one scale for both, so that they can be compared
    reach = max(1.0, float(np.abs([response.slope_global, response.slope_lve]).max()))
    _draw_slope(figure, axes[1], response, response.slope_global, reach, r"$\partial H/\partial q_g$")
    _draw_slope(figure, axes[2], response, response.slope_lve, reach, r"$\partial H/\partial q_l$")
    for axis in axes:
        axis.plot(*response.actual, "o", color="white", markeredgecolor="black", markersize=8, label="at this state")
        axis.set_xlabel("global value $q_g$")
    axes[0].set(xlim=response.q_global[[0, -1]], ylim=response.q_lve[[0, -1]])
    axes[0].set_ylabel("weighted local value $q_l$")
    axes[0].legend(fontsize=9, loc="upper left")
    figure.suptitle(f"Re-fusion, {response.refusion}", fontsize=11)
    return figure


def _draw_slope(figure: Figure, axis: Axes, response: Response, slope: np.ndarray, reach: float, name: str) -> None:
    # purple below zero, orange above: told apart by colour-blind people, and by the hatch in greyscale
    mesh = axis.pcolormesh(
        response.q_global,
        response.q_lve,
        slope,
        cmap="PuOr_r",
        norm=TwoSlopeNorm(0.0, -reach, reach),
        shading="nearest",
        rasterized=True,
    )
    figure.colorbar(mesh, ax=axis)
    negative = slope < 0
    if negative.any():
        axis.contourf(
            *(response.q_global, response.q_lve, negative.astype(float)),
            levels=[0.5, 1.5],
            colors="none",
            hatches=["///"],
        )
    low, high = slope.min(), slope.max()
    value = f"{low:.2f}" if np.isclose(low, high, atol=5e-3) else f"{low:.2f} to {high:.2f}"
    sign = f", negative on {100 * negative.mean():.0f} %" if negative.any() else ""
    axis.set_title(f"{name}: {value}{sign}", fontsize=MEDIUM)
