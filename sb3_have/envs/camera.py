"""A pinhole camera on the roof of a car: from poses to what every pixel sees.

Objects (vehicles, trees, guard-rails) are vertical rectangles. Their face numbers are painted far to near with OpenCV
at twice the resolution; the plane equation of the painted face then gives each sample its exact depth, height and
place on the face, and a small texture its material. The flat ground needs no painting: every pixel's share of
asphalt, marking and verge is known in closed form, box-filtered over the pixel's footprint. Several instants are
rendered in one pass, because at these image sizes the cost is numpy calls and not pixels.

World frame: x forward along the road, y to the right, z up, metres. Camera frame: forward, right. Image: u to the
right, v down, in pixels, the centre of the first pixel at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

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
#: Paint of vehicles: white, silver, black, red, blue, yellow, green. None is as grey as the road.
PAINTS: Final = np.array(
    [
        (0.80, 0.80, 0.78),
        (0.50, 0.52, 0.54),
        (0.025, 0.025, 0.03),
        (0.50, 0.04, 0.03),
        (0.04, 0.08, 0.40),
        (0.75, 0.55, 0.05),
        (0.04, 0.25, 0.10),
    ],
    dtype=np.float32,
)
ASPHALT: Final = np.array((0.11, 0.11, 0.115), dtype=np.float32)
MARKING: Final = np.array((0.70, 0.70, 0.68), dtype=np.float32)
VERGE: Final = np.array((0.10, 0.17, 0.05), dtype=np.float32)


def _texture(rows: list[str]) -> NDArray[np.int16]:
    """A face drawn in letters, top row first; stored bottom row first."""
    letters = {"g": GLASS, "k": RUBBER, "l": LAMP, "s": STEEL, "j": JOINT, "t": LEAVES, "d": LEAVES_DARK, "b": BODY}
    drawn = [[letters[letter] for letter in row] for row in rows[::-1]]
    # Every texture has 10 x 20 cells, so that one table holds them all.
    return np.kron(np.array(drawn, dtype=np.int16), np.ones((10 // len(drawn), 20 // len(drawn[0])), dtype=np.int16))


REAR, FRONT, SIDE, RAIL, TREE = range(5)
TEXTURES: Final = np.stack(
    [
        _texture(
            [
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
            ]
        ),
        _texture(["bbbbbbbbbb", "bggggggggb", "bbbbbbbbbb", "bbbkkkkbbb", "kkkkkkkkkk"]),
        _texture(["bbbbbbbbbb", "bggggbgggb", "bbbbbbbbbb", "bkkbbbbkkb", "kkkkkkkkkk"]),
        _texture(["sssssssssj"]),
        _texture(["tdtdt", "dttdt"]),
    ]
)

VEHICLE_HEIGHT: Final = 1.5
NEAR: Final = 0.5
FAR: Final = 200.0
SUPERSAMPLING: Final = 2
LINE_WIDTH: Final = 0.2
DASH_LENGTH: Final = 3.0
DASH_PERIOD: Final = 12.0
SHOULDER_WIDTH: Final = 2.0
RAIL_JOINTS: Final = 4.0
TREE_SPACING: Final = 20.0
TREE_RANGE: Final = 140.0
#: Faces run from s = 0 to just under 1, so that their right edge still falls into the last cell of the texture.
S_END: Final = 0.9999
#: World x repeats itself with this period, so that single precision holds on a long road.
WORLD_PERIOD: Final = 240.0


@dataclass
class Ground:
    """Shares of each pixel under the horizon, float32 (instants, rows, columns); the rest of the road is asphalt."""

    road: Array
    marking: Array
    verge: Array  # brightness factor of the verge's own texture


@dataclass
class Objects:
    """Samples that hit an object, at ``SUPERSAMPLING`` squared samples a pixel. All arrays are (samples,)."""

    pixel: NDArray[np.int64]  # flat index into (instants, height, width)
    depth: Array  # metres along the optical axis
    material: NDArray[np.int64]
    face: NDArray[np.int64]  # index into the arrays below
    face_normal: Array  # (faces, 2), outward, world frame
    face_vehicle: NDArray[np.int64]  # (faces,), index of the traffic vehicle or -1

    def last(self, instants: int, pixels: int) -> Objects:
        """The samples of the last of several instants of so many pixels, as if it had been rendered alone."""
        first = (instants - 1) * pixels
        since = int(np.searchsorted(self.pixel, first))  # pixels of one instant are in no order, but instants are
        last = (part[since:] for part in (self.pixel - first, self.depth, self.material, self.face))
        return Objects(*last, self.face_normal, self.face_vehicle)


class Camera:
    """
    Pinhole camera 1 m ahead of the ego's centre and 1.5 m above the road, looking along its heading.

    :param image_size: Rows and columns.
    :param lanes_count: Lanes of the road.
    :param lane_width: Width of a lane in metres; the centre of lane k lies at y = k * lane_width.
    :param field_of_view: Horizontal and vertical angle in degrees.
    """

    offset = 1.0
    height = 1.5

    def __init__(self, image_size: int, lanes_count: int, lane_width: float, field_of_view: float = 60.0) -> None:
        self.size = image_size
        self.lanes_count = lanes_count
        self.lane_width = lane_width
        self.focal = 0.5 * image_size / np.tan(np.radians(field_of_view / 2))
        self.centre = 0.5 * image_size
        #: First image row whose centre looks at the ground.
        self.horizon = int(np.ceil(self.centre - 0.5 + 1e-9))
        centres = np.arange(image_size) + 0.5
        self.slope = ((centres - self.centre) / self.focal).astype(np.float32)
        #: Distance of the ground in each row from the horizon down, (rows, 1), and its offset to the right.
        self.ground_forward = (self.height / self.slope[self.horizon :, None]).astype(np.float32)
        self.ground_right = self.ground_forward * self.slope[None, :]
        samples = (np.arange(SUPERSAMPLING * image_size) + 0.5) / SUPERSAMPLING
        self._sample_u = samples.astype(np.float32)
        self._sample_slope = ((samples - self.centre) / self.focal).astype(np.float32)
        # Grass is a patchwork of random brightness; trees stand at random places. The road is the same in every run.
        scenery = np.random.default_rng(0)
        self._grass = scenery.uniform(0.55, 1.45, (64, 64)).astype(np.float32)
        self._trees = scenery.uniform(-1.0, 1.0, (2, int(WORLD_PERIOD / TREE_SPACING), 2))

    def depth(self, objects: Objects) -> Array:
        """
        Depth of one instant.

        :param objects: Its objects.
        :return: (height, width) metres along the optical axis, the nearest in each pixel; infinite for the sky.
        """
        depth = np.full((self.size, self.size), np.inf, dtype=np.float32)
        depth[self.horizon :] = self.ground_forward
        np.minimum.at(depth.reshape(-1), objects.pixel, objects.depth)
        return depth

    def pose(self, poses: Array) -> tuple[Array, Array, Array]:
        """Position x, y and heading of the camera, (instants,) each, from poses (instants, vehicles, 3)."""
        x, y, heading = np.moveaxis(poses[:, 0], -1, 0)
        return x + self.offset * np.cos(heading), y + self.offset * np.sin(heading), heading

    def ground(self, poses: Array) -> Ground:
        """
        What the ground looks like.

        :param poses: (instants, 1 + vehicles, 3): x, y, heading; row 0 is the ego.
        :return: Shares of road and marking and the verge's texture for each pixel from the horizon down.
        """
        x, y, heading = self.pose(poses)
        sin, cos = (f(heading).astype(np.float32)[:, None, None] for f in (np.sin, np.cos))
        along = (
            (x % WORLD_PERIOD).astype(np.float32)[:, None, None] + cos * self.ground_forward - sin * self.ground_right
        )
        across = y.astype(np.float32)[:, None, None] + sin * self.ground_forward + cos * self.ground_right
        # Size of a pixel on the ground.
        wide = self.ground_forward / np.float32(self.focal)
        long = np.minimum(wide * self.ground_forward / np.float32(self.height), np.float32(FAR))

        lane = across / np.float32(self.lane_width) + np.float32(0.5)
        line = np.clip(np.rint(lane), 0, self.lanes_count)
        distance = np.abs(lane - line) * np.float32(self.lane_width)
        marking = np.clip((LINE_WIDTH / 2 + wide / 2 - distance) / wide, 0, np.minimum(1, LINE_WIDTH / wide))
        painted = (_dashes(along + long / 2) - _dashes(along - long / 2)) / long
        marking *= np.where((line > 0) & (line < self.lanes_count), painted, np.float32(1))

        half = np.float32(self.lanes_count * self.lane_width / 2)
        from_middle = np.abs(across - (half - np.float32(self.lane_width / 2)))
        road = np.clip((half + SHOULDER_WIDTH - from_middle) / wide + np.float32(0.5), 0, 1)
        cell_x, cell_y = along.astype(np.int32) & 63, across.astype(np.int32) & 63
        # A patch smaller than a pixel averages out.
        fade = np.minimum(1, 2 / np.maximum(wide, long))
        verge = 1 + (self._grass[cell_x, cell_y] - 1) * fade
        return Ground(road, marking, verge)

    def objects(self, poses: Array, sizes: Array) -> Objects:
        """
        What stands on the ground.

        :param poses: As in :meth:`ground`.
        :param sizes: (1 + vehicles, 2): length and width in metres.
        :return: One entry per sample that sees an object.
        """
        faces = self._faces(poses, sizes)
        painted = self._paint(len(poses), faces)
        sample = np.flatnonzero(painted)
        face = painted.reshape(-1)[sample].astype(np.int64) - 1
        instant, sample = np.divmod(sample, (SUPERSAMPLING * self.size) ** 2)
        row, column = np.divmod(sample, SUPERSAMPLING * self.size)
        pixel = (instant * self.size + row // SUPERSAMPLING) * self.size + column // SUPERSAMPLING

        # Inverse depth, and s over depth, are linear along an image row. Beyond its edges a face goes on as at its edge.
        at = faces.plane[face]
        q = np.clip((self._sample_u[column] - at[:, 0]) * at[:, 1], 0, 1)
        depth = 1 / (at[:, 2] + q * at[:, 3])
        s = (at[:, 4] + q * at[:, 5]) * depth
        z = np.float32(self.height) - self._sample_slope[row] * depth
        cell_z = np.clip((z - at[:, 6]) * at[:, 7], 0, 9).astype(np.int64)
        cell_s = (20 * s).astype(np.int64) % 20
        kind, vehicle = faces.kind[face], faces.vehicle[face]
        material = TEXTURES[kind, cell_z, cell_s]
        material = np.where(material == BODY, BODY + vehicle, material)
        return Objects(pixel, depth, material, face, faces.normal, faces.vehicle)

    def _faces(self, poses: Array, sizes: Array) -> _Faces:
        """Every face that may be seen, in the order in which they are painted."""
        x, y, heading = self.pose(poses)
        parts = [self._trees_at(x), self._rails_at(x), _vehicle_faces(poses, sizes, x, y, heading)]
        start, end, normal, s0, s1, z0, z1, kind, vehicle = (np.concatenate(part, axis=1) for part in zip(*parts))

        start, end = _to_camera(start, x, y, heading), _to_camera(end, x, y, heading)
        # Turned towards the camera: its left end lies left of its right end. The rest is behind, beside or too far.
        seen = start[..., 0] * end[..., 1] > start[..., 1] * end[..., 0]
        seen &= (np.maximum(start[..., 0], end[..., 0]) > 2 * NEAR) & (np.minimum(start[..., 0], end[..., 0]) < FAR)
        instant = np.nonzero(seen)[0]
        start, end, s0, s1 = start[seen], end[seen], s0[seen], s1[seen]
        start, end, s0, s1 = _clip_near(start, end, s0, s1)
        end, start, s1, s0 = _clip_near(end, start, s1, s0)

        inverse0, inverse1 = 1 / start[:, 0], 1 / end[:, 0]
        u0 = self.centre + self.focal * start[:, 1] * inverse0
        u1 = self.centre + self.focal * end[:, 1] * inverse1
        z0, z1 = z0[seen], z1[seen]
        plane = np.stack(
            (u0, 1 / np.maximum(u1 - u0, 1e-6), inverse0, inverse1 - inverse0)
            + (s0 * inverse0, s1 * inverse1 - s0 * inverse0, z0, 10 / (z1 - z0)),
            axis=-1,
        ).astype(np.float32)
        low, high = self.focal * (self.height - z0), self.focal * (self.height - z1)
        v = self.centre + np.stack((low * inverse0, low * inverse1, high * inverse1, high * inverse0), axis=-1)
        return _Faces(instant, kind[seen], vehicle[seen], normal[seen], plane, u0, u1, v)

    def _paint(self, instants: int, faces: _Faces) -> NDArray[np.int16]:
        """Number of the face (from 1) that each sample sees, (instants, rows, columns) of samples; 0 for none."""
        side = SUPERSAMPLING * self.size
        canvas = np.zeros((instants, side, side), dtype=np.int16)
        tip = np.where(faces.kind == TREE, (faces.u0 + faces.u1) / 2, np.nan)
        top1, top0 = np.where(np.isnan(tip), faces.u1, tip), np.where(np.isnan(tip), faces.u0, tip)
        corners = np.stack((np.stack((faces.u0, faces.u1, top1, top0), axis=-1), faces.v), axis=-1)
        # OpenCV paints the outline too: half a sample on each side. A face always keeps one sample.
        corners = corners * SUPERSAMPLING - 0.5
        middle = corners.mean(axis=1, keepdims=True)
        corners -= np.clip(corners - middle, -0.5, 0.5)
        polygons = np.rint(corners * 16).astype(np.int32)
        for number, (instant, polygon) in enumerate(zip(faces.instant.tolist(), polygons), start=1):
            cv2.fillConvexPoly(canvas[instant], polygon, number, shift=4)
        return canvas

    def _trees_at(self, x: Array) -> tuple[Array, ...]:
        """Firs on both sides of the road, far to near."""
        instants, count = len(x), int(TREE_RANGE / TREE_SPACING)
        number = int(x[0] // TREE_SPACING) + np.arange(count, -1, -1)
        jitter = self._trees[:, number % self._trees.shape[1]]
        edge = 0.5 * self.lanes_count * self.lane_width + SHOULDER_WIDTH + 5
        middle = 0.5 * (self.lanes_count - 1) * self.lane_width
        tree_x = number * TREE_SPACING + 4 * jitter[..., 0]
        tree_y = middle + np.array([[-1], [1]]) * (edge + 2.5 * jitter[..., 1])
        tree = np.stack((tree_x, tree_y), axis=-1).swapaxes(0, 1).reshape(-1, 2)
        return _same_for_all(instants, tree - (0, 1.6), tree + (0, 1.6), (-1.0, 0.0), 0.0, S_END, 0.0, 7.0, TREE, -1)

    def _rails_at(self, x: Array) -> tuple[Array, ...]:
        """Guard-rails on both sides, from behind the camera to the end of sight."""
        near, far = x[0] - 5, x[0] + FAR
        left = -0.5 * self.lane_width - SHOULDER_WIDTH - 0.5
        right = (self.lanes_count - 0.5) * self.lane_width + SHOULDER_WIDTH + 0.5
        origin = WORLD_PERIOD * (x[0] // WORLD_PERIOD - 1)
        s_near, s_far = (near - origin) / RAIL_JOINTS, (far - origin) / RAIL_JOINTS
        return _same_for_all(
            len(x),
            np.array([(near, left), (far, right)]),
            np.array([(far, left), (near, right)]),
            np.array([(0.0, 1.0), (0.0, -1.0)]),
            np.array([s_near, s_far]),
            np.array([s_far, s_near]),
            0.45,
            0.8,
            RAIL,
            -1,
        )


@dataclass
class _Faces:
    """Faces turned to the camera, far to near in each instant, (faces, ...) each."""

    instant: NDArray[np.int64]
    kind: NDArray[np.int64]
    vehicle: NDArray[np.int64]
    normal: Array
    plane: Array  # (faces, 8): u0, 1 / (u1 - u0), 1 / depth, its change, s / depth, its change, bottom, cells per metre
    u0: Array
    u1: Array
    v: Array  # (faces, 4): bottom left, bottom right, top right, top left


def _same_for_all(instants: int, start: Array, end: Array, normal: object, *values: object) -> tuple[Array, ...]:
    """Faces (faces, ...) that stand still, repeated for every instant."""
    count = len(start)
    points = (np.broadcast_to(np.asarray(part), (instants, count, 2)) for part in (start, end, normal))
    return (*points, *(np.broadcast_to(np.asarray(value), (instants, count)) for value in values))


def _vehicle_faces(poses: Array, sizes: Array, x: Array, y: Array, heading: Array) -> tuple[Array, ...]:
    """The four sides of every vehicle near the field of view, far to near, in world coordinates."""
    traffic, extent = poses[:, 1:], 0.5 * sizes[1:]
    forward, right = np.moveaxis(_to_camera(traffic[..., :2], x, y, heading), -1, 0)
    near_view = ((forward > -4) & (forward < FAR + 4) & (np.abs(right) < 0.6 * forward + 12)).any(axis=0)
    index = np.flatnonzero(near_view)
    order = index[np.argsort(-np.hypot(forward[:, index], right[:, index]), axis=1, kind="stable")]

    pose = np.take_along_axis(traffic, order[..., None], axis=1)
    ahead = np.stack((np.cos(pose[..., 2]), np.sin(pose[..., 2])), axis=-1)
    aside = np.stack((-ahead[..., 1], ahead[..., 0]), axis=-1)
    half = extent[order]
    length, width = half[..., :1] * ahead, half[..., 1:] * aside
    middle = pose[..., :2]
    rear_left, rear_right = middle - length - width, middle - length + width
    front_right, front_left = middle + length + width, middle + length - width
    start = np.stack((rear_left, rear_right, front_right, front_left), axis=2)
    end = np.stack((rear_right, front_right, front_left, rear_left), axis=2)
    normal = np.stack((-ahead, aside, ahead, -aside), axis=2)
    instants, count = order.shape
    shape = (instants, 4 * count)
    return (
        start.reshape(*shape, 2),
        end.reshape(*shape, 2),
        normal.reshape(*shape, 2),
        np.zeros(shape),
        np.full(shape, S_END),
        np.zeros(shape),
        np.full(shape, VEHICLE_HEIGHT),
        np.broadcast_to(np.tile((REAR, SIDE, FRONT, SIDE), count), shape),
        np.repeat(order, 4, axis=1),
    )


def _to_camera(points: Array, x: Array, y: Array, heading: Array) -> Array:
    """World points (instants, n, 2) in the camera frame: forward, right."""
    dx, dy = points[..., 0] - x[:, None], points[..., 1] - y[:, None]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return np.stack((cos * dx + sin * dy, cos * dy - sin * dx), axis=-1)


def _clip_near(start: Array, end: Array, s0: Array, s1: Array) -> tuple[Array, Array, Array, Array]:
    """Move starts that lie behind the near plane along their face onto it."""
    share = np.clip((NEAR - start[:, 0]) / np.where(start[:, 0] < NEAR, end[:, 0] - start[:, 0], 1), 0, 1)
    return start + share[:, None] * (end - start), end, s0 + share * (s1 - s0), s1


def _dashes(x: Array) -> Array:
    """Integral from 0 to x of the dash pattern (1 on paint, 0 on asphalt)."""
    period = np.floor(x / DASH_PERIOD)
    return period * DASH_LENGTH + np.minimum(x - period * DASH_PERIOD, DASH_LENGTH)
