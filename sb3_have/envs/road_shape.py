"""
The geometry of a road, shared by its lanes and its picture.

World coordinates in metres: x forward, y to the right; every road leads towards +x. *Across* is y minus the bend of the
road at the same x, so that the centre of lane k is at across = k * lane_width on any road. All shapes repeat along x
with
:data:`PERIOD`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

# Period of the roads [m]
PERIOD: Final = 480.0
# Amplitude of a winding road [m]; its smallest radius is 486 m
SWING: Final = 12.0
# Offset to the right at which a ramp begins [m]
RAMP_OFFSET: Final = 36.0
# Distances from the beginning of a ramp [m] at which it becomes a lane beside the road, begins to taper, and ends
RAMP_JOINS: Final = 240.0
RAMP_TAPERS: Final = 420.0
RAMP_ENDS: Final = 460.0

# Width of the pavement beyond the outer lines [m]
SHOULDER_WIDTH: Final = 2.0

_WAVE: Final = 2 * math.pi / PERIOD

SCENARIOS: Final = ("highway", "merge", "curves")


@dataclass(frozen=True)
class RoadShape:
    """
    The geometry of a road. Functions of x accept a float or an array of any shape and precision and return the same.

    :param lanes_count: Number of lanes, not counting ramps; lane 0 is the leftmost.
    :param lane_width: Width of a lane in metres.
    :param swing: Amplitude of the sine that the road follows in metres; 0 for a straight road.
    :param oncoming: Number of lanes, from the left, that are driven towards -x.
    :param ramps: Whether a ramp joins the road from the right in every period.
    """

    lanes_count: int
    lane_width: float = 4.0
    swing: float = 0.0
    oncoming: int = 0
    ramps: bool = False

    @property
    def plain(self) -> bool:
        """Whether the road looks the same at every x."""
        return not (self.swing or self.ramps)

    @property
    def right_edge(self) -> float:
        """Across coordinate of the right edge of the rightmost lane [m], not counting ramps."""
        return (self.lanes_count - 0.5) * self.lane_width

    @property
    def middle(self) -> float:
        """Across coordinate of the middle of the road [m], not counting ramps."""
        return 0.5 * (self.lanes_count - 1) * self.lane_width

    @property
    def half_width(self) -> float:
        """Half the width of the pavement with its shoulders [m], not counting ramps."""
        return 0.5 * self.lanes_count * self.lane_width + SHOULDER_WIDTH

    def bend(self, x: Any) -> Any:
        """Offset of the road to the right of the x axis [m] at x [m]."""
        return self.swing * (np.sin(_WAVE * x) if isinstance(x, np.ndarray) else math.sin(_WAVE * x))

    def slope(self, x: Any) -> Any:
        """Return the derivative of :meth:`bend`, the tangent of the heading of the road at x [m]."""
        phase = _WAVE * x + 0.5 * math.pi
        return self.swing * 2 * math.pi / PERIOD * (np.sin(phase) if isinstance(x, np.ndarray) else math.sin(phase))

    def direction(self, x: float) -> tuple[float, float]:
        """Return the unit vector along the road at x [m]."""
        if not self.swing:
            return 1.0, 0.0
        heading = math.atan(self.slope(x))
        return math.cos(heading), math.sin(heading)

    def has_ramp(self, x: Any, until: float = RAMP_ENDS) -> Any:
        """Whether there is a ramp at x [m] that began less than ``until`` [m] before."""
        return self.ramps & (x % PERIOD < until)

    def ramp(self, x: Any) -> tuple[Any, Any]:
        """Across coordinates [m] of the edges of the ramp at x [m]; both are the edge of the road if there is none."""
        if not self.ramps:
            return self.right_edge + 0 * x, self.right_edge + 0 * x
        u = x % PERIOD
        offset = RAMP_OFFSET * _positive(1 - u / RAMP_JOINS) ** 2
        taper = (u - RAMP_TAPERS) / (RAMP_ENDS - RAMP_TAPERS)
        left = self.right_edge + offset
        return left, left + self.lane_width * (1 - _positive(taper) + _positive(taper - 1))

    def ramp_slope(self, x: Any) -> tuple[Any, Any]:
        """Return the derivatives of the edges that :meth:`ramp` returns at x [m]."""
        if not self.ramps:
            return 0 * x, 0 * x
        u = x % PERIOD
        left = -2 * RAMP_OFFSET / RAMP_JOINS * _positive(1 - u / RAMP_JOINS)
        tapering = 0.5 * (np.sign(u - RAMP_TAPERS) - np.sign(u - RAMP_ENDS))
        return left, left - self.lane_width / (RAMP_ENDS - RAMP_TAPERS) * tapering


def road_shape(scenario: str, lanes_count: int, lane_width: float = 4.0) -> RoadShape:
    """
    Return the road of a scenario.

    :param scenario: "highway" is straight with all lanes towards +x, "merge" has an additional on-ramp every 480 m,
        "curves" is winding with the left half of the lanes towards -x.
    :param lanes_count: Number of lanes, not counting ramps.
    :param lane_width: Width of a lane in metres.
    :raises ValueError: If the scenario is unknown or cannot have this number of lanes.
    """
    if scenario not in SCENARIOS:
        raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}; got {scenario!r}")
    if scenario == "curves":
        if lanes_count % 2:
            raise ValueError(
                f"lanes_count must be even in scenario 'curves', which has half of the lanes in each direction, got "
                f"{lanes_count}"
            )
        return RoadShape(lanes_count, lane_width, swing=SWING, oncoming=lanes_count // 2)
    return RoadShape(lanes_count, lane_width, ramps=scenario == "merge")


def _positive(x: Any) -> Any:
    """Larger of x and 0."""
    return 0.5 * (x + abs(x))
