"""The re-fusion H(q_g, q_l) and its slopes at one observation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from sb3_have.plotting.style import MEDIUM

POINTS = 61


class Response(NamedTuple):
    """
    H on a grid of G global and L local values.

    :param q_global: Global values, (G,)
    :param q_lve: Weighted local values, (L,)
    :param h: H, (L, G)
    :param slope_global: dH/dq_g, (L, G)
    :param slope_lve: dH/dq_l, (L, G)
    :param actual: q_g and q_l of the observation and the policy's action, averaged over the twins
    :param refusion: The form of the re-fusion network
    """

    q_global: np.ndarray
    q_lve: np.ndarray
    h: np.ndarray
    slope_global: np.ndarray
    slope_lve: np.ndarray
    actual: tuple[float, float]
    refusion: str


def refusion_response(
    model: Any, observation: Any, q_global: ArrayLike | None = None, q_lve: ArrayLike | None = None
) -> Response:
    """
    Compute H and its exact slopes for other values at an observation.

    :param model: A :class:`~sb3_have.HAVESAC` with ``value_estimation="have"``
    :param observation: One observation, as for ``predict``
    :param q_global: Global values, (G,); by default around the actual one, as far as the two values differ and at
        least 10 in both directions
    :param q_lve: Weighted local values, (L,); by default around the actual one in the same way
    """
    critic = model.critic
    if getattr(critic, "refusion", None) is None:
        raise ValueError(f'value_estimation={critic.value_estimation!r} has no re-fusion: train with "have"')

    # Compute the actual values; predict() also switches to evaluation mode
    action, _ = model.predict(observation, deterministic=True)
    tensors, _ = model.policy.obs_to_tensor(observation)
    scaled = np.reshape(model.policy.scale_action(action), (-1, int(np.prod(model.action_space.shape))))
    if len(scaled) != 1:
        raise ValueError(f"expected one observation, got a batch of {len(scaled)}")
    with th.no_grad():
        features = critic.encoder(tensors)
        values = critic.values(features, th.as_tensor(scaled, dtype=th.float32, device=model.device))
        actual = float(values.q_global.mean()), float(values.q_lve.mean())

    # Compute H and its slopes on the grid
    reach = max(10.0, abs(actual[0] - actual[1]))
    grids = [
        np.linspace(centre - reach, centre + reach, POINTS) if given is None else np.asarray(given, float)
        for given, centre in zip((q_global, q_lve), actual, strict=True)
    ]
    mesh = np.meshgrid(*grids)  # (L, G) each
    inputs = [th.tensor(axis.ravel()[None], dtype=features.dtype, device=model.device) for axis in mesh]
    inputs = [tensor.requires_grad_() for tensor in inputs]
    h = critic.refusion(*inputs, features.expand(mesh[0].size, -1, -1))  # (1, L * G)
    slopes = th.autograd.grad(h.sum(), inputs)
    surfaces = [part.detach().cpu().numpy().reshape(mesh[0].shape) for part in (h, *slopes)]
    return Response(grids[0], grids[1], surfaces[0], surfaces[1], surfaces[2], actual, critic.refusion.refusion)


def plot_refusion(response: Response) -> Figure:
    """
    Plot H and its slopes in q_g and q_l; negative slopes are hatched.

    :param response: Output of :func:`refusion_response`
    """
    figure = Figure(figsize=(11.0, 3.7), layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    surface = response.q_global, response.q_lve, response.h
    filled = axes[0].contourf(*surface, levels=16, cmap="cividis")
    lines = axes[0].contour(
        *surface, levels=filled.levels[::2], colors="white", linewidths=0.7, negative_linestyles="solid"
    )
    figure.colorbar(filled, ax=axes[0]).add_lines(lines)
    axes[0].set_title("H", fontsize=MEDIUM)
    # Use the same scale for both slopes so that they can be compared
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
    # Purple below zero and orange above can be distinguished by colour-blind people, and by the hatch in greyscale
    grid = response.q_global, response.q_lve
    norm = TwoSlopeNorm(0.0, -reach, reach)
    mesh = axis.pcolormesh(*grid, slope, cmap="PuOr_r", norm=norm, shading="nearest", rasterized=True)
    figure.colorbar(mesh, ax=axis)
    negative = slope < 0
    if negative.any():
        axis.contourf(*grid, negative.astype(float), levels=[0.5, 1.5], colors="none", hatches=["///"])
    low, high = slope.min(), slope.max()
    value = f"{low:.2f}" if np.isclose(low, high, atol=5e-3) else f"{low:.2f} to {high:.2f}"
    sign = f", negative on {100 * negative.mean():.0f} %" if negative.any() else ""
    axis.set_title(f"{name}: {value}{sign}", fontsize=MEDIUM)
