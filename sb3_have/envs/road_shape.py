"""Where a road runs and how it is divided: what its lanes, on which cars drive, and its picture have in common.

World coordinates: x forward, y to the right, metres; every road leads towards +x. *Across* is y less the road's bend at
the same x, so that lane k has its centre at across = k * lane_width on any road. All shapes repeat themselves along x
with :data:`PERIOD`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

#: The roads repeat themselves [m].
PERIOD: Final = 480.0
#: How far the centre line of a winding road swings to either side [m]: its radius is 486 m where it is least.
SWING: Final = 12.0
#: A ramp begins this far to the right of where it joins the road [m] ...
RAMP_OFFSET: Final = 36.0
#: ... and, metres from its beginning: where it becomes a lane beside the road, where that lane begins to taper and
#: where nothing is left of it.
RAMP_JOINS: Final = 240.0
RAMP_TAPERS: Final = 420.0
RAMP_ENDS: Final = 460.0

#: The pavement goes on beyond the outer lines [m].
SHOULDER_WIDTH: Final = 2.0

_WAVE: Final = 2 * math.pi / PERIOD

SCENARIOS: Final = ("highway", "merge", "curves")


@dataclass(frozen=True)
class RoadShape:
    """
    The geometry of a road. Functions of x take a float or an array of any shape and precision and return the like.

    :param lanes_count: Lanes, not counting ramps; lane 0 is the leftmost.
    :param lane_width: In metres.
    :param swing: Amplitude in metres of the sine that the road follows; 0 for a straight road.
    :param oncoming: How many lanes, from the left, are driven towards -x.
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
        """Across coordinate of the right edge of the right-most lane, not counting ramps."""
        return (self.lanes_count - 0.5) * self.lane_width

    @property
    def middle(self) -> float:
        """Across coordinate of the middle of the road, not counting ramps."""
        return 0.5 * (self.lanes_count - 1) * self.lane_width

    @property
    def half_width(self) -> float:
        """Half the width of the pavement, shoulders included, not counting ramps."""
        return 0.5 * self.lanes_count * self.lane_width + SHOULDER_WIDTH

    def bend(self, x: Any) -> Any:
        """How far the road lies to the right of the x axis [m]."""
        return self.swing * _sin(_WAVE * x)

    def slope(self, x: Any) -> Any:
        """Derivative of :meth:`bend`, the tangent of the road's heading."""
        return self.swing * 2 * math.pi / PERIOD * _sin(_WAVE * x + 0.5 * math.pi)

    def direction(self, x: float) -> tuple[float, float]:
        """Unit vector along the road."""
        if not self.swing:
            return 1.0, 0.0
        heading = math.atan(self.slope(x))
        return math.cos(heading), math.sin(heading)

    def has_ramp(self, x: Any, until: float = RAMP_ENDS) -> Any:
        """Whether there is a ramp at x that began less than so many metres before."""
        return self.ramps & (x % PERIOD < until)

    def ramp(self, x: Any) -> tuple[Any, Any]:
        """Across coordinates of a ramp's left and right edge; both are the road's own edge where there is no ramp."""
        if not self.ramps:
            return self.right_edge + 0 * x, self.right_edge + 0 * x
        u = x % PERIOD
        offset = RAMP_OFFSET * _positive(1 - u / RAMP_JOINS) ** 2
        taper = (u - RAMP_TAPERS) / (RAMP_ENDS - RAMP_TAPERS)
        left = self.right_edge + offset
        return left, left + self.lane_width * (1 - _positive(taper) + _positive(taper - 1))

    def ramp_slope(self, x: Any) -> tuple[Any, Any]:
        """Derivatives of the edges that :meth:`ramp` returns."""
        if not self.ramps:
            return 0 * x, 0 * x
        u = x % PERIOD
        left = -2 * RAMP_OFFSET / RAMP_JOINS * _positive(1 - u / RAMP_JOINS)
        tapering = 0.5 * (np.sign(u - RAMP_TAPERS) - np.sign(u - RAMP_ENDS))
        return left, left - self.lane_width / (RAMP_ENDS - RAMP_TAPERS) * tapering


def road_shape(scenario: str, lanes_count: int, lane_width: float = 4.0) -> RoadShape:
    """
    The road of a scenario.

    :param scenario: "highway", straight, all lanes towards +x; "merge", the same with an on-ramp every 480 m; "curves",
        winding, the left half of the lanes driven towards -x.
    :param lanes_count: Lanes in all, not counting ramps.
    :param lane_width: In metres.
    :raises ValueError: on an unknown scenario or a number of lanes that it cannot have.
    """
    if scenario not in SCENARIOS:
        raise ValueError(f"scenario must be one of {', '.join(SCENARIOS)}; got {scenario!r}")
    if scenario == "curves":
        if lanes_count % 2:
            raise ValueError(
                f"lanes_count must be even in scenario 'curves', which has half of the lanes in either direction; "
                f"got {lanes_count}, choose {f'{lanes_count - 1} or ' if lanes_count > 1 else ''}{lanes_count + 1}"
            )
        return RoadShape(lanes_count, lane_width, swing=SWING, oncoming=lanes_count // 2)
    return RoadShape(lanes_count, lane_width, ramps=scenario == "merge")


def _sin(x: Any) -> Any:
    return math.sin(x) if isinstance(x, float) else np.sin(x)


def _positive(x: Any) -> Any:
    """The larger of x and 0."""
    return 0.5 * (x + abs(x))
