"""
The flat ground as a camera sees it: the shares of marking, road and verge in every pixel.

All shares have a closed form, box-filtered over the footprint of the pixel on the ground. Where the road runs at an
angle to the view, the length of the footprint matters as well as its width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.road_shape import PERIOD, RAMP_ENDS, RAMP_JOINS, SHOULDER_WIDTH, RoadShape
from sb3_have.envs.scene import (
    CENTRE_LINES,
    DASH_LENGTH,
    DASH_PERIOD,
    LINE_WIDTH,
    RAMP_DASH_PERIOD,
    Array,
    IntArray,
)

# Footprints are limited to this length [m], which is shorter than anything on a road that begins and ends
LONGEST: Final = 200.0


@dataclass
class Ground:
    """
    The ground in each pixel below the horizon, float32 (instants, rows, columns) each.

    :param road: Share of the paved road; the rest is verge.
    :param marking: Share of the road that is painted; the rest is asphalt.
    :param verge: Brightness factor of the patchwork of the verge.
    """

    road: Array
    marking: Array
    verge: Array

    def last(self) -> Ground:
        """Return the last instant."""
        return Ground(self.road[-1:], self.marking[-1:], self.verge[-1:])


class GroundView:
    """
    The ground as a camera sees it.

    :param shape: Shape of the road.
    :param forward: Distance of the ground in each row in metres, float32 (rows, 1).
    :param right: Its offset to the right in each pixel in metres, float32 (rows, columns).
    :param focal: Focal length in pixels.
    :param height: Height of the camera in metres.
    """

    def __init__(self, shape: RoadShape, forward: Array, right: Array, focal: float, height: float) -> None:
        self.shape, self.forward, self.right = shape, forward, right
        self.middle, self.half_width = np.float32(shape.middle), np.float32(shape.half_width)
        # Width and length of a pixel on the ground [m], (rows, 1)
        self.wide = forward / np.float32(focal)
        self.long = np.minimum(self.wide * forward / np.float32(height), np.float32(LONGEST))
        # Remaining contrast of the patches of 1 m, which average out where they are smaller than a pixel
        self.contrast = np.minimum(1, 2 / np.maximum(self.wide, self.long))
        # The verge is a patchwork of random brightness, the same in every episode
        self.patchwork = np.random.default_rng(0).uniform(0.55, 1.45, (64, 64)).astype(np.float32)

    def look(self, x: Array, y: Array, heading: Array) -> Ground:
        """
        Render the ground.

        :param x: Position of the camera along the road in metres, float32 (instants, 1, 1).
        :param y: Position of the camera across the road in metres, same shape.
        :param heading: Heading of the camera in radians, same shape.
        """
        shape, width = self.shape, np.float32(self.shape.lane_width)
        sin, cos = np.sin(heading), np.cos(heading)
        along: Array = x + cos * self.forward - sin * self.right
        across: Array = y + sin * self.forward + cos * self.right
        span, narrow = self.wide, None
        if shape.swing:
            across = across - shape.bend(along)
            span, narrow = _footprint(self.wide, self.long, shape.slope(along), sin, cos)

        lane = across / width + np.float32(0.5)
        line: Array = np.clip(np.rint(lane), 0, shape.lanes_count)
        distance: Array = np.abs(lane - line) * width
        beyond: Array = np.abs(across - self.middle) - self.half_width
        if narrow is not None:
            distance, beyond = distance * narrow, beyond * narrow
        marking = _line_share(distance, span)
        road = np.clip(np.float32(0.5) - beyond / span, 0, 1)
        # Lines between lanes are dashed
        inner = (marking != 0) & (line > 0) & (line < shape.lanes_count)
        if shape.oncoming:
            self._draw_centre(marking, line, distance, span)
            inner &= line != shape.oncoming
        between = np.flatnonzero(inner)
        marking.reshape(-1)[between] *= self._dashes(along, between, DASH_PERIOD)
        if shape.ramps:
            # So is the edge of the road beside an acceleration lane. The footprint may reach back to the previous ramp.
            since = along % PERIOD
            beside = np.maximum(
                _share_between(since, self.long, RAMP_JOINS, RAMP_ENDS),
                _share_between(since + PERIOD, self.long, RAMP_JOINS, RAMP_ENDS),
            )
            opened = np.flatnonzero((marking != 0) & (line == shape.lanes_count) & (beside != 0))
            gaps = 1 - self._dashes(along, opened, RAMP_DASH_PERIOD)
            marking.reshape(-1)[opened] *= 1 - beside.take(opened) * gaps
            self._add_ramps(marking, road, along, across, sin, cos)

        patch = (np.floor(along).astype(np.int32) & 63) * 64 + (np.floor(across).astype(np.int32) & 63)
        verge = 1 + (self.patchwork.take(patch) - 1) * self.contrast
        return Ground(road, marking, verge)

    def _dashes(self, along: Array, dashed: IntArray, period: float) -> Array:
        """Share of the length of these pixels that dashes cover."""
        middle = along.take(dashed)
        length = self.long[dashed // along.shape[2] % len(self.long), 0]
        paint = _painted_length(middle + length / 2, period) - _painted_length(middle - length / 2, period)
        return np.asarray(paint / length)

    def _draw_centre(self, marking: Array, line: Array, distance: Array, span: Array) -> None:
        """Draw two solid lines side by side between the directions."""
        centre = np.flatnonzero(line == self.shape.oncoming)
        distance, span = distance.take(centre), span.take(centre)
        both = _line_share(np.abs(distance - CENTRE_LINES), span) + _line_share(distance + CENTRE_LINES, span)
        marking.reshape(-1)[centre] = np.minimum(both, 1)

    def _add_ramps(self, marking: Array, road: Array, along: Array, across: Array, sin: Array, cos: Array) -> None:
        """Draw the last ramp that began before each pixel, and its neighbours where the footprint reaches them."""
        since, half = along % PERIOD, self.long / 2
        self._draw_ramp(marking, road, since, across, sin, cos, slice(None))
        for shift, reaches in [(-PERIOD, since + half > PERIOD), (PERIOD, since - half < RAMP_ENDS - PERIOD)]:
            rows = np.flatnonzero(reaches.any(axis=(0, 2)))
            if len(rows):
                self._draw_ramp(marking, road, since + shift, across, sin, cos, slice(rows[0], rows[-1] + 1))

    def _draw_ramp(
        self, marking: Array, road: Array, since: Array, across: Array, sin: Array, cos: Array, rows: slice
    ) -> None:
        """
        Draw the pavement and the two solid lines of a ramp; the left line ends where the ramp joins the road.

        :param since: Metres since the beginning of the ramp, negative before it.
        :param rows: Rows to draw.
        """
        marking, road, since, across = marking[:, rows], road[:, rows], since[:, rows], across[:, rows]
        wide, long = self.wide[rows], self.long[rows]
        covered = _share_between(since, long, 0, RAMP_ENDS)
        start, middle, end = (np.clip(x, 0, RAMP_ENDS) for x in (since - long / 2, since, since + long / 2))
        length = np.maximum(end - start, np.float32(1e-3))
        beyond: list[Array] = []
        for sign, *edges in zip((1, -1), *map(self.shape.ramp, (start, middle, end)), strict=True):
            edge, slope = edges[1], (edges[2] - edges[0]) / length
            span, narrow = _footprint(wide, long, slope, sin, cos)
            outside = sign * (edge - across) * narrow
            beyond.append((outside - SHOULDER_WIDTH) / span)
            paint = _line_share(np.abs(outside), span)
            paint *= covered if sign < 0 else _share_between(since, long, 0, RAMP_JOINS)
            np.maximum(marking, paint, out=marking)
        np.maximum(road, covered * np.clip(np.float32(0.5) - np.maximum(*beyond), 0, 1), out=road)


def _footprint(wide: Array, long: Array, slope: Array, sin: Array, cos: Array) -> tuple[Array, Array]:
    """
    Return the extent of a footprint perpendicular to a line of this slope, in metres.

    The second value converts distances along y into distances perpendicular to the line.
    """
    narrow = 1 / np.sqrt(1 + slope * slope)
    along, aside = (cos + sin * slope) * narrow, (sin - cos * slope) * narrow
    return wide * np.abs(along) + long * np.abs(aside), narrow


def _share_between(x: Array, length: Array, first: float, last: float) -> Array:
    """Share of a footprint of this length, centred at x, between two places that are farther apart than that."""
    inside = np.minimum(x - np.float32(first), np.float32(last) - x)
    return np.asarray(np.clip(inside / length + np.float32(0.5), 0, 1))


def _line_share(distance: Array, span: Array) -> NDArray[np.float32]:
    """Share of a footprint of this span that lies on a line at this distance, measured between the centres [m]."""
    share = np.maximum((LINE_WIDTH / 2 + span / 2 - distance) / span, 0)
    return np.asarray(np.minimum(share, np.minimum(1, LINE_WIDTH / span)))


def _painted_length(x: Array, dash_period: float) -> Array:
    """Length of paint [m] on a dashed line between 0 and x."""
    period = np.floor(x / np.float32(dash_period))
    painted: Array = period * DASH_LENGTH + np.minimum(x - period * np.float32(dash_period), DASH_LENGTH)
    return painted
