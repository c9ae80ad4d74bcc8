"""
Objects on and along the road, in world coordinates in metres: x forward, y to the right, z up.

Everything above the ground is a vertical rectangle (a fir is a triangle) with a small texture of materials.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.road_shape import PERIOD, SHOULDER_WIDTH, RoadShape

Array = NDArray[np.floating]
IntArray = NDArray[np.integer]

# Materials, the rows of the albedo table; vehicle n has the material BODY + n
GLASS, RUBBER, LAMP, STEEL, JOINT, LEAVES, LEAVES_DARK, HEADLAMP, BODY = range(9)
# Albedo (red, green, blue) of the materials below BODY
ALBEDO: Final = np.array(
    [
        (0.03, 0.035, 0.04),
        (0.02, 0.02, 0.02),
        (0.45, 0.03, 0.03),
        (0.42, 0.43, 0.45),
        (0.10, 0.10, 0.10),
        (0.05, 0.10, 0.03),
        (0.03, 0.06, 0.02),
        (0.60, 0.60, 0.60),
    ],
    dtype=np.float32,
)
# Paints of vehicles: white, silver, black, red, blue, yellow, green. None is as bright as the road, or an event camera
# could not distinguish it.
PAINTS: Final = np.array(
    [
        (0.80, 0.80, 0.78),
        (0.50, 0.52, 0.54),
        (0.025, 0.025, 0.03),
        (0.75, 0.08, 0.06),
        (0.03, 0.05, 0.22),
        (0.75, 0.55, 0.05),
        (0.08, 0.42, 0.14),
    ],
    dtype=np.float32,
)
ASPHALT: Final = np.array((0.11, 0.11, 0.115), dtype=np.float32)
MARKING: Final = np.array((0.70, 0.70, 0.68), dtype=np.float32)
VERGE: Final = np.array((0.10, 0.17, 0.05), dtype=np.float32)

# Height of vehicles, width of lines, length and period of dashes, also beside a ramp [m]
VEHICLE_HEIGHT: Final = 1.5
LINE_WIDTH: Final = 0.2
DASH_LENGTH: Final = 3.0
DASH_PERIOD: Final = 12.0
RAMP_DASH_PERIOD: Final = 6.0
# Distance of each of the two lines between the directions from their centre [m]
CENTRE_LINES: Final = 0.2
# Period of the roadside [m]. Positions are taken modulo this period, so that single precision suffices on any road. It
# is a multiple of the periods of the road, dashes (12 m), trees (20 m), joints (4 m) and verge (64 m).
WORLD_PERIOD: Final = 2 * PERIOD
# Guard-rails: distance from the pavement, lower and upper edge, distance between joints [m]
RAIL_SETBACK: Final = 0.5
RAIL_BOTTOM: Final = 0.45
RAIL_TOP: Final = 0.8
RAIL_JOINTS: Final = 4.0
# Length of the pieces in which curved guard-rails are drawn [m], a whole number of joints
RAIL_PIECE: Final = 20.0
# Trees: height, half width, spacing along the road, distance up to which they are drawn [m]
TREE_HEIGHT: Final = 7.0
TREE_HALF_WIDTH: Final = 1.6
TREE_SPACING: Final = 20.0
TREE_RANGE: Final = 140.0

# Cells of every texture along the height and the length of a face
TEXTURE_ROWS, TEXTURE_COLUMNS = 10, 20


def _texture(*rows: str) -> NDArray[np.int64]:
    """Convert a face drawn in letters, top row first, to materials, bottom row first."""
    letters = {"g": GLASS, "k": RUBBER, "l": LAMP, "s": STEEL, "j": JOINT, "t": LEAVES, "d": LEAVES_DARK, "b": BODY}
    letters["h"] = HEADLAMP
    drawn = np.array([[letters[letter] for letter in row] for row in rows[::-1]])
    return drawn.repeat(TEXTURE_ROWS // len(drawn), axis=0).repeat(TEXTURE_COLUMNS // len(drawn[0]), axis=1)


# Kinds of faces, the rows of the table of textures
REAR, FRONT, SIDE, RAIL, TREE, FRONT_LIT = range(6)
TEXTURES: Final = np.stack(
    [
        _texture(
            "bbbbbbbbbb",
            "bggggggggb",
            "bggggggggb",
            "bggggggggb",
            "bbbbbbbbbb",
            "llbbbbbbll",
            "llbbbbbbll",
            "bbbbbbbbbb",
            "kkkkkkkkkk",
            "kkkkkkkkkk",
        ),
        _texture("bbbbbbbbbb", "bggggggggb", "bbbbbbbbbb", "bbbkkkkbbb", "kkkkkkkkkk"),
        _texture("bbbbbbbbbb", "bggggbgggb", "bbbbbbbbbb", "bkkbbbbkkb", "kkkkkkkkkk"),
        _texture("sssssssssj"),
        _texture("tdtdt", "dttdt"),
        _texture(
            "bbbbbbbbbb",
            "bggggggggb",
            "bggggggggb",
            "bggggggggb",
            "bbbbbbbbbb",
            "hhbbbbbbhh",
            "hhbkkkkbhh",
            "bbbkkkkbbb",
            "kkkkkkkkkk",
            "kkkkkkkkkk",
        ),
    ]
)


# Heights of the lower and the upper edge of each kind of face [m]
BOTTOM: Final = np.array((0.0, 0.0, 0.0, RAIL_BOTTOM, 0.0, 0.0))
TOP: Final = np.array((*3 * (VEHICLE_HEIGHT,), RAIL_TOP, TREE_HEIGHT, VEHICLE_HEIGHT))


@dataclass
class Faces:
    """
    Vertical rectangles, (instants, faces, ...) each. Their heights follow from their kind, see :data:`BOTTOM` and
    :data:`TOP`.

    :param start: x, y of the left end, seen from outside [m].
    :param end: x, y of the right end [m].
    :param normal: Outward normal.
    :param s_start: Place of the left end on the texture, which repeats with period 1.
    :param s_end: Place of the right end on the texture.
    :param kind: Kind of face.
    :param vehicle: Number of the traffic vehicle or -1.
    """

    start: Array
    end: Array
    normal: Array
    s_start: Array
    s_end: Array
    kind: IntArray
    vehicle: IntArray

    @staticmethod
    def concatenate(*parts: Faces) -> Faces:
        """
        Concatenate faces.

        :param parts: Faces in their order.
        """
        return Faces(*(np.concatenate([getattr(part, f.name) for part in parts], axis=1) for f in fields(Faces)))

    def take(self, flat: IntArray) -> Faces:
        """
        Select faces; the result has a single axis of faces.

        :param flat: Indices into the flattened arrays.
        """
        start, end, normal = (part.reshape(-1, 2).take(flat, axis=0) for part in (self.start, self.end, self.normal))
        s_start, s_end = self.s_start.take(flat), self.s_end.take(flat)
        return Faces(start, end, normal, s_start, s_end, self.kind.take(flat), self.vehicle.take(flat))


class Roadside:
    """
    Guard-rails and firs along a road, the same in every episode.

    :param shape: Shape of the road.
    """

    def __init__(self, shape: RoadShape) -> None:
        self.shape = shape
        jitter = (int(WORLD_PERIOD / TREE_SPACING), 2, 2)
        self._jitter = np.random.default_rng(0).uniform(-1, 1, jitter) * (4.0, 2.5)

    def faces(self, x: Array, sight: float) -> tuple[Faces, Faces]:
        """
        Return the trees and the rails that are visible, far to near on a plain road.

        :param x: Position of the camera along the road in metres, (instants,).
        :param sight: Distance at which the guard-rails end in metres.
        """
        return self._trees(x), self._rail(x, sight) if self.shape.plain else self._pieces(x, sight)

    def behind_rail(self, y: Array) -> Array:
        """
        Return how far objects stand behind the right rail of the road where there is a ramp, 0 to 1.

        It is 0 from the road to the rail and 1 from the ramp on. In between it grows so gradually that a vehicle never
        hides others that are closer.

        :param y: Position of the objects across the road in metres.
        """
        if not self.shape.ramps:
            return np.zeros(y.shape)
        rail = self.shape.middle + self.shape.half_width + RAIL_SETBACK
        return np.asarray(np.clip((y - rail) / self.shape.lane_width, 0, 1))

    def _trees(self, x: Array) -> Faces:
        # Use the faces around the x of each instant, so that it does not depend on the other instants
        number = (x[:, None] // TREE_SPACING).astype(np.int64) + np.arange(int(TREE_RANGE / TREE_SPACING), -1, -1)
        tree = self._jitter[number % len(self._jitter)]
        tree[..., 0] += TREE_SPACING * number[..., None]
        tree[..., 1] += self.shape.middle + np.array((-1, 1)) * (self.shape.half_width + 5)
        if not self.shape.plain:
            tree[..., 1] += self.shape.bend(tree[..., 0])
            tree[:, :, 1, 1] += self._widening(tree[:, :, 1, 0])
        tree = tree.reshape(len(x), -1, 2)
        to_end, one = np.array((0.0, TREE_HALF_WIDTH)), np.ones(tree.shape[:2])
        return Faces(
            start=tree - to_end,
            end=tree + to_end,
            normal=one[..., None] * (-1.0, 0.0),
            s_start=0 * one,
            s_end=one,
            kind=np.full(one.shape, TREE),
            vehicle=np.full(one.shape, -1),
        )

    def _rail(self, x: Array, sight: float) -> Faces:
        """Left and right rail of a plain road, in one piece each."""
        near, far = x - 5, x + sight
        y = np.tile(self.shape.middle + np.array((-1, 1)) * (self.shape.half_width + RAIL_SETBACK), (len(x), 1))
        s_near = near % RAIL_JOINTS / RAIL_JOINTS
        s_far = s_near + (far - near) / RAIL_JOINTS
        ends = (np.stack((near, far), axis=1), np.stack((far, near), axis=1))
        start, end = (np.stack((along, y), axis=-1) for along in ends)
        return _steel(start, end, np.stack((s_near, s_far), axis=1), np.stack((s_far, s_near), axis=1))

    def _pieces(self, x: Array, sight: float) -> Faces:
        """Rails that follow the road: left, right, and between the road and a ramp that is about to join."""
        number = x[:, None] // RAIL_PIECE + np.arange(-1, int(sight / RAIL_PIECE) + 1)
        # Just inside of the piece, because there is a step where a ramp begins
        near, far = RAIL_PIECE * number + 1e-3, RAIL_PIECE * (number + 1) - 1e-3
        shift = self.shape.half_width + RAIL_SETBACK
        left, right = self.shape.middle - shift, self.shape.middle + shift
        ends = [(np.stack((u, left + self.shape.bend(u)), axis=-1)) for u in (near, far)]
        outer = [(np.stack((u, right + self.shape.bend(u) + self._widening(u)), axis=-1)) for u in (far, near)]
        starts, stops = [ends[0], outer[0]], [ends[1], outer[1]]
        if self.shape.ramps:
            # The rail of the road ends where there is no more room for it; from there on its length is 0
            gap = self.shape.ramp(far)[0] - self.shape.right_edge - 2 * SHOULDER_WIDTH
            begin = np.where(gap > 1, far, near)
            starts.append(np.stack((begin, right + 0 * begin), axis=-1))
            stops.append(np.stack((near, right + 0 * near), axis=-1))
        start, end = np.concatenate(starts, axis=1), np.concatenate(stops, axis=1)
        s = np.full(start.shape[:2], RAIL_PIECE / RAIL_JOINTS)
        return _steel(start, end, 0 * s, s)

    def _widening(self, x: Array) -> Array:
        """Distance of the right edge of a ramp from that of the road [m]."""
        return np.asarray(self.shape.ramp(x)[1]) - self.shape.right_edge


def _steel(start: Array, end: Array, s_start: Array, s_end: Array) -> Faces:
    """Guard-rails."""
    along = end - start
    length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-9)[..., None]
    return Faces(
        start=start,
        end=end,
        normal=np.stack((-along[..., 1], along[..., 0]), axis=-1) / length,
        s_start=s_start,
        s_end=s_end,
        kind=np.full(s_end.shape, RAIL),
        vehicle=np.full(s_end.shape, -1),
    )


def vehicle_faces(poses: Array, sizes: Array, order: IntArray, front: int = FRONT) -> Faces:
    """
    Return the four sides of vehicles.

    :param poses: x [m], y [m] and heading [rad] of the traffic, (instants, vehicles, 3).
    :param sizes: Length and width in metres, (vehicles, 2).
    :param order: Vehicles to show at each instant, far to near, (instants, shown).
    :param front: Kind of the front faces.
    """
    pose, half = poses[np.arange(len(poses))[:, None], order], 0.5 * sizes[order]
    ahead = np.stack((np.cos(pose[..., 2]), np.sin(pose[..., 2])), axis=-1)
    aside = np.stack((-ahead[..., 1], ahead[..., 0]), axis=-1)
    length, width, middle = half[..., :1] * ahead, half[..., 1:] * aside, pose[..., :2]
    corners = np.stack(
        (middle - length - width, middle - length + width, middle + length + width, middle + length - width), axis=2
    )
    instants, count = order.shape
    shape = (instants, 4 * count)
    return Faces(
        start=corners.reshape(*shape, 2),
        end=corners[:, :, (1, 2, 3, 0)].reshape(*shape, 2),
        normal=np.stack((-ahead, aside, ahead, -aside), axis=2).reshape(*shape, 2),
        s_start=np.zeros(shape),
        s_end=np.ones(shape),
        kind=np.tile((REAR, SIDE, front, SIDE), (instants, count)),
        vehicle=np.repeat(order, 4, axis=1),
    )
