"""What stands on and along the road, in world coordinates: x forward along the road, y to the right, z up, metres.

Everything that rises from the ground is a vertical rectangle (a fir is a triangle) with a small texture of materials.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
IntArray = NDArray[np.integer]

# Materials: rows of the albedo table. Vehicle n has material BODY + n.
GLASS, RUBBER, LAMP, STEEL, JOINT, LEAVES, LEAVES_DARK, BODY = range(8)
#: Albedo (red, green, blue) of the materials below BODY.
ALBEDO: Final = np.array(
    [
        (0.03, 0.035, 0.04),
        (0.02, 0.02, 0.02),
        (0.45, 0.03, 0.03),
        (0.42, 0.43, 0.45),
        (0.10, 0.10, 0.10),
        (0.05, 0.10, 0.03),
        (0.03, 0.06, 0.02),
    ],
    dtype=np.float32,
)
#: Paint of vehicles: white, silver, black, red, blue, yellow, green. None is as bright as the road, which an event
#: camera could not tell from it.
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

VEHICLE_HEIGHT: Final = 1.5
SHOULDER_WIDTH: Final = 2.0
LINE_WIDTH: Final = 0.2
DASH_LENGTH: Final = 3.0
DASH_PERIOD: Final = 12.0
#: The roadside repeats itself with this period, and positions are taken modulo it: single precision holds on any road.
#: A multiple of all that repeats on its own: dashes (12 m), trees (20 m), joints (4 m) and the verge (64 m).
WORLD_PERIOD: Final = 960.0
RAIL_BOTTOM: Final = 0.45
RAIL_TOP: Final = 0.8
RAIL_JOINTS: Final = 4.0
TREE_HEIGHT: Final = 7.0
TREE_HALF_WIDTH: Final = 1.6
TREE_SPACING: Final = 20.0
TREE_RANGE: Final = 140.0

#: Cells of every texture, over the height and over the length of a face.
TEXTURE_ROWS, TEXTURE_COLUMNS = 10, 20


def _texture(*rows: str) -> NDArray[np.int64]:
    """A face drawn in letters, top row first; stored bottom row first."""
    letters = {"g": GLASS, "k": RUBBER, "l": LAMP, "s": STEEL, "j": JOINT, "t": LEAVES, "d": LEAVES_DARK, "b": BODY}
    drawn = np.array([[letters[letter] for letter in row] for row in rows[::-1]])
    return drawn.repeat(TEXTURE_ROWS // len(drawn), axis=0).repeat(TEXTURE_COLUMNS // len(drawn[0]), axis=1)


# Kinds of faces: rows of the table of textures.
REAR, FRONT, SIDE, RAIL, TREE = range(5)
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
    ]
)


@dataclass
class Faces:
    """Vertical rectangles, (instants, faces, ...) each. Seen from outside, ``start`` is their left end."""

    start: Array  # x, y
    end: Array
    normal: Array  # outward
    s_start: Array  # place on the texture, which repeats with period 1
    s_end: Array
    bottom: Array
    top: Array
    kind: IntArray
    vehicle: IntArray  # number of the traffic vehicle, or -1

    @staticmethod
    def concatenate(*parts: Faces) -> Faces:
        """All faces of the parts, in their order."""
        return Faces(*(np.concatenate([getattr(part, f.name) for part in parts], axis=1) for f in fields(Faces)))


class Roadside:
    """
    Guard-rails and firs along a road, the same in every episode.

    :param lanes_count: Lanes of the road; the centre of lane k lies at y = k * lane_width.
    :param lane_width: In metres.
    """

    def __init__(self, lanes_count: int, lane_width: float) -> None:
        self.middle = 0.5 * (lanes_count - 1) * lane_width
        #: Half the width of the paved road with its shoulders.
        self.half_width = 0.5 * lanes_count * lane_width + SHOULDER_WIDTH
        shape = (int(WORLD_PERIOD / TREE_SPACING), 2, 2)
        self._jitter = np.random.default_rng(0).uniform(-1, 1, shape) * (4.0, 2.5)

    def faces(self, x: Array, sight: float) -> Faces:
        """
        What can be seen from each x, far to near.

        :param x: Positions along the road, (instants,).
        :param sight: Distance at which the guard-rails end.
        """
        # Every instant has the faces around its own x, so that it looks the same whichever others are rendered with it.
        number = (x[:, None] // TREE_SPACING).astype(np.int64) + np.arange(int(TREE_RANGE / TREE_SPACING), -1, -1)
        tree = self._jitter[number % len(self._jitter)]
        tree[..., 0] += TREE_SPACING * number[..., None]
        tree[..., 1] += self.middle + np.array((-1, 1)) * (self.half_width + 5)
        tree = tree.reshape(len(x), -1, 2)
        to_end = np.array((0.0, TREE_HALF_WIDTH))

        near, far = x - 5, x + sight
        rail_y = np.tile(self.middle + np.array((-1, 1)) * (self.half_width + 0.5), (len(x), 1))  # left, right
        s_near = near % RAIL_JOINTS / RAIL_JOINTS
        s_far = s_near + (far - near) / RAIL_JOINTS
        trees, rails = np.ones(tree.shape[:2]), np.ones((len(x), 2))
        parts = (
            (tree - to_end, np.stack((np.stack((near, far), axis=1), rail_y), axis=-1)),
            (tree + to_end, np.stack((np.stack((far, near), axis=1), rail_y), axis=-1)),
            (trees[..., None] * (-1.0, 0.0), rails[..., None] * [(0.0, 1.0), (0.0, -1.0)]),
            (0 * trees, np.stack((s_near, s_far), axis=1)),
            (trees, np.stack((s_far, s_near), axis=1)),
            (0 * trees, RAIL_BOTTOM * rails),
            (TREE_HEIGHT * trees, RAIL_TOP * rails),
            (np.full(trees.shape, TREE), np.full(rails.shape, RAIL)),
            (np.full(trees.shape, -1), np.full(rails.shape, -1)),
        )
        return Faces(*(np.concatenate(part, axis=1) for part in parts))


def vehicle_faces(poses: Array, sizes: Array, order: IntArray) -> Faces:
    """
    The four sides of vehicles.

    :param poses: Traffic, (instants, vehicles, 3): x, y, heading.
    :param sizes: (vehicles, 2): length, width.
    :param order: (instants, shown): the vehicles to show at each instant, far to near.
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
        end=np.roll(corners, -1, axis=2).reshape(*shape, 2),
        normal=np.stack((-ahead, aside, ahead, -aside), axis=2).reshape(*shape, 2),
        s_start=np.zeros(shape),
        s_end=np.ones(shape),
        bottom=np.zeros(shape),
        top=np.full(shape, VEHICLE_HEIGHT),
        kind=np.tile((REAR, SIDE, FRONT, SIDE), (instants, count)),
        vehicle=np.repeat(order, 4, axis=1),
    )
