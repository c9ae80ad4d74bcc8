"""A pinhole camera on the roof of a car: from poses to what every pixel sees.

Objects are painted face by face, far to near, with OpenCV at twice the resolution. The plane equation of the painted
face then gives each sample its exact depth and place on the face, and the face's texture its material. The ground needs
no painting, see :mod:`sb3_have.envs.ground`. Several instants are rendered in one pass, because at these image sizes
the cost is numpy calls, not pixels.

Camera frame: forward, right, metres. Image: u to the right, v down, in pixels; the first pixel's centre is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.ground import Ground, GroundView
from sb3_have.envs.road_shape import RoadShape
from sb3_have.envs.scene import (
    BODY,
    FRONT,
    FRONT_LIT,
    RAIL_PIECE,
    TEXTURE_COLUMNS,
    TEXTURE_ROWS,
    TEXTURES,
    TREE,
    WORLD_PERIOD,
    Array,
    Faces,
    IntArray,
    Roadside,
    vehicle_faces,
)

NEAR: Final = 0.5
FAR: Final = 200.0
#: Samples per pixel and direction.
SUPERSAMPLING: Final = 2


@dataclass
class Objects:
    """Samples that hit an object, (samples,) each unless said otherwise."""

    pixel: NDArray[np.int64]  # flat index into (instants, height, width)
    depth: Array  # metres along the optical axis
    material: IntArray
    face: IntArray  # index into the following
    normal: Array  # (faces, 2), outward, world frame
    vehicle: IntArray  # (faces,), number of the traffic vehicle or -1

    def last(self, instants: int, pixels: int) -> Objects:
        """The samples of the last of several instants of so many pixels each, as if it had been rendered alone."""
        first = (instants - 1) * pixels
        since = int(np.searchsorted(self.pixel, first))  # the pixels of an instant are in no order, the instants are
        pixel, depth = self.pixel[since:] - first, self.depth[since:]
        return Objects(pixel, depth, self.material[since:], self.face[since:], self.normal, self.vehicle)


class Camera:
    """
    Pinhole camera 1 m ahead of the ego's centre and 1.5 m above the road, looking along its heading.

    :param image_size: Rows and columns.
    :param shape: Of the road.
    :param field_of_view: Horizontal and vertical angle in degrees.
    """

    offset = 1.0
    height = 1.5

    def __init__(self, image_size: int, shape: RoadShape, field_of_view: float = 60.0) -> None:
        self.size = image_size
        self.shape = shape
        self.roadside = Roadside(shape)
        # Nobody sees the front of a car that goes the same way.
        self._front = FRONT_LIT if shape.oncoming else FRONT
        self.focal = float(0.5 * image_size / np.tan(np.radians(field_of_view / 2)))
        self.centre = 0.5 * image_size
        #: First image row that looks at the ground. In an odd number of rows the middle one looks at infinity.
        self.horizon = image_size // 2 + image_size % 2
        #: Tangent of the angle to the axis, of every column and every row, of pixels and of samples.
        self.slope = self._tangent(np.arange(image_size) + 0.5)
        self._sample_u = ((np.arange(SUPERSAMPLING * image_size) + 0.5) / SUPERSAMPLING).astype(np.float32)
        self._sample_slope = self._tangent(self._sample_u)
        #: Distance of the ground in each row from the horizon down, (rows, 1), and its offset to the right.
        self.ground_forward = np.float32(self.height) / self.slope[self.horizon :, None]
        self.ground_right = self.ground_forward * self.slope
        self.ground_view = GroundView(shape, self.ground_forward, self.ground_right, self.focal, self.height)

    def ground(self, poses: Array) -> Ground:
        """
        What the ground looks like.

        :param poses: (instants, 1 + vehicles, 3): x, y, heading; row 0 is the ego.
        """
        x, y, heading = (value.astype(np.float32)[:, None, None] for value in self._pose(poses, WORLD_PERIOD))
        return self.ground_view.look(x, y, heading)

    def objects(self, poses: Array, sizes: Array) -> Objects:
        """
        What stands on the ground.

        :param poses: As in :meth:`ground`.
        :param sizes: (1 + vehicles, 2): length and width in metres.
        """
        faces = self._project(poses, sizes)
        painted = self._paint(len(poses), faces).reshape(-1)
        sample = np.flatnonzero(painted != 0)
        face = painted[sample].astype(np.int64) - 1
        # Line: row of the images stacked. (numpy divides by a constant much faster than it takes a remainder.)
        line = sample.astype(np.int32) // (SUPERSAMPLING * self.size)
        column = sample - SUPERSAMPLING * self.size * line
        pixel = line // SUPERSAMPLING * self.size + column // SUPERSAMPLING

        # Inverse depth, and s over depth, are linear along an image row.
        u0, per_pixel, inverse, inverse_change, s, s_change, s_max, bottom, cells = faces.plane.take(face, axis=1)
        q = np.clip((self._sample_u[column] - u0) * per_pixel, 0, 1)
        depth = 1 / (inverse + q * inverse_change)
        cell_s = np.floor(TEXTURE_COLUMNS * np.minimum((s + q * s_change) * depth, s_max)).astype(np.int32)
        z = np.float32(self.height) - np.tile(self._sample_slope, len(poses))[line] * depth
        cell_z = np.clip((z - bottom) * cells, 0, TEXTURE_ROWS - 1).astype(np.int32)
        cell = (faces.kind.take(face) * TEXTURE_ROWS + cell_z) * TEXTURE_COLUMNS + cell_s % TEXTURE_COLUMNS
        material = TEXTURES.take(cell)
        body = np.flatnonzero(material == BODY)
        material[body] += faces.vehicle[face[body]]
        return Objects(pixel, depth, material, face, faces.normal, faces.vehicle)

    def depth(self, objects: Objects) -> Array:
        """
        Depth of one instant, (height, width): metres along the optical axis to the nearest object that a sample of the
        pixel hits, else to the ground; infinite in the sky.
        """
        depth = np.full((self.size, self.size), np.inf, dtype=np.float32)
        depth[self.horizon :] = self.ground_forward
        depth.reshape(-1)[objects.pixel] = np.inf
        np.minimum.at(depth.reshape(-1), objects.pixel, objects.depth)
        return depth

    def _tangent(self, pixels: Array) -> NDArray[np.float32]:
        return ((pixels - self.centre) / self.focal).astype(np.float32)

    def _pose(self, poses: Array, period: float = np.inf) -> tuple[Array, Array, Array]:
        """Position x (modulo a period), y and heading of the camera, (instants,) each."""
        x, y, heading = np.moveaxis(poses[:, 0], -1, 0)
        x = x + self.offset * np.cos(heading)
        return x if period == np.inf else x % period, y + self.offset * np.sin(heading), heading

    def _project(self, poses: Array, sizes: Array) -> _Projected:
        """The faces that the camera sees, far to near in each instant."""
        x, y, heading = self._pose(poses)
        traffic = poses[:, 1:]
        forward, right = np.moveaxis(_to_camera(traffic[..., :2], x, y, heading), -1, 0)
        in_view = (forward > -5) & (forward < FAR + 5) & (np.abs(right) < 0.6 * forward + 12)
        shown = np.flatnonzero(in_view.any(axis=0))
        order = shown[np.argsort(-np.hypot(forward[:, shown], right[:, shown]), axis=1, kind="stable")]
        faces = Faces.concatenate(*self.roadside.faces(x, FAR), vehicle_faces(traffic, sizes[1:], order, self._front))

        start, end = _to_camera(faces.start, x, y, heading), _to_camera(faces.end, x, y, heading)
        # Turned towards the camera: the start lies to the left of the end.
        seen = start[..., 0] * end[..., 1] > start[..., 1] * end[..., 0]
        seen &= np.maximum(start[..., 0], end[..., 0]) > 2 * NEAR
        # A vehicle is shown at the instants at which it is in view; number -1, the roadside, at all.
        every = np.arange(len(poses))[:, None]
        seen &= np.concatenate((in_view, every >= 0), axis=1)[every, faces.vehicle]
        instant, face = np.nonzero(seen)
        if not self.shape.plain:
            # A road that bends or forks has its roadside before vehicles as well as behind them.
            away = np.maximum(np.hypot(*start[instant, face].T), np.hypot(*end[instant, face].T))
            vehicle = faces.vehicle[instant, face]
            middle = np.concatenate((np.hypot(forward, right), 0.0 * every), axis=1)
            away = np.where(vehicle < 0, away, middle[instant, vehicle])
            # A piece of rail counts by its farther end: all that stands behind rails is still farther.
            place = np.concatenate((traffic[..., :2], np.zeros((len(poses), 1, 2))), axis=1)[instant, vehicle]
            place = np.where(vehicle[:, None] < 0, 0.5 * (faces.start + faces.end)[instant, face], place)
            away += RAIL_PIECE * (self.roadside.behind_rail(place) + (faces.kind[instant, face] == TREE))
            order = np.argsort(-away, kind="stable")
            instant, face = instant[order], face[order]
        start, end = start[instant, face], end[instant, face]
        faces = Faces(*(getattr(faces, field.name)[instant, face] for field in fields(Faces)))
        start, s_start = _clip_near(start, end, faces.s_start, faces.s_end)
        end, s_end = _clip_near(end, start, faces.s_end, s_start)

        inverse0, inverse1 = 1 / start[:, 0], 1 / end[:, 0]
        u0 = self.centre + self.focal * start[:, 1] * inverse0
        u1 = self.centre + self.focal * end[:, 1] * inverse1
        bottom, top = self.focal * (self.height - faces.bottom), self.focal * (self.height - faces.top)
        v = self.centre + np.stack((bottom * inverse0, bottom * inverse1, top * inverse1, top * inverse0), axis=-1)
        tip = np.where(faces.kind == TREE, 0.5, 0.0) * (u1 - u0)
        u = np.stack((u0, u1, u1 - tip, u0 + tip), axis=-1)
        s0, s1 = s_start * inverse0, s_end * inverse1
        # Just under the end of the texture, so that a sample on a face's edge falls into the last cell.
        s_max = np.maximum(faces.s_start, faces.s_end) - 1e-4
        cells = TEXTURE_ROWS / (faces.top - faces.bottom)
        per_pixel = 1 / np.maximum(u1 - u0, 1e-6)
        plane = np.array(
            (u0, per_pixel, inverse0, inverse1 - inverse0, s0, s1 - s0, s_max, faces.bottom, cells), dtype=np.float32
        )
        return _Projected(instant, np.stack((u, v), axis=-1), plane, faces.kind, faces.normal, faces.vehicle)

    def _paint(self, instants: int, faces: _Projected) -> NDArray[np.int32]:
        """Number of the face (from 1) that each sample sees, (instants, rows, columns) of samples; 0 for none."""
        side = SUPERSAMPLING * self.size
        canvas = np.zeros((instants, side, side), dtype=np.int32)
        corners = faces.corners * SUPERSAMPLING - 0.5
        # OpenCV paints the outline too, half a sample on each side; a face always keeps one sample.
        corners -= np.clip(corners - corners.mean(axis=1, keepdims=True), -0.5, 0.5)
        polygons = np.rint(corners * 16).astype(np.int32)
        for number, (instant, polygon) in enumerate(zip(faces.instant.tolist(), polygons, strict=True), start=1):
            cv2.fillConvexPoly(canvas[instant], polygon, number, shift=4)
        return canvas


@dataclass
class _Projected:
    """Faces in the image, (faces, ...) each."""

    instant: IntArray
    corners: Array  # (faces, 4, 2): u, v of bottom left, bottom right, top right, top left
    #: (9, faces): u0, 1 / width, 1 / depth, its change, s / depth, its change, largest s, bottom, cells / m
    plane: NDArray[np.float32]
    kind: IntArray
    normal: Array
    vehicle: IntArray


def _to_camera(points: Array, x: Array, y: Array, heading: Array) -> Array:
    """World points (instants, n, 2) in the camera frame: forward, right."""
    dx, dy = points[..., 0] - x[:, None], points[..., 1] - y[:, None]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return np.stack((cos * dx + sin * dy, cos * dy - sin * dx), axis=-1)


def _clip_near(point: Array, other: Array, s: Array, s_other: Array) -> tuple[Array, Array]:
    """Move the points that lie behind the near plane along their face onto it, and their s with them."""
    behind = point[:, 0] < NEAR
    share = np.where(behind, (NEAR - point[:, 0]) / np.where(behind, other[:, 0] - point[:, 0], 1), 0)
    return point + share[:, None] * (other - point), s + share * (s_other - s)
