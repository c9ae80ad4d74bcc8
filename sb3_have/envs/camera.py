"""
A pinhole camera on the roof of a car, which turns poses into what every pixel sees.

Objects are painted with OpenCV face by face, far to near, at twice the resolution. The plane equation of the painted
face then gives the exact depth and place on the face of each sample, and the texture of the face gives its material.
The ground is not painted, see :mod:`sb3_have.envs.ground`. Several instants are rendered in one pass, because at these
image sizes NumPy calls dominate the cost.

Camera frame: forward and right, in metres. Image: u to the right, v down, in pixels; the centre of the first pixel is
(0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_have.envs.ground import Ground, GroundView
from sb3_have.envs.road_shape import RoadShape
from sb3_have.envs.scene import (
    BODY,
    BOTTOM,
    FRONT,
    FRONT_LIT,
    RAIL_PIECE,
    TEXTURE_COLUMNS,
    TEXTURE_ROWS,
    TEXTURES,
    TOP,
    TREE,
    WORLD_PERIOD,
    Array,
    Faces,
    IntArray,
    Roadside,
    vehicle_faces,
)

# Near plane and range of sight [m]
NEAR: Final = 0.5
FAR: Final = 200.0
# Samples per pixel and direction
SUPERSAMPLING: Final = 2


@dataclass
class Objects:
    """
    Samples that hit an object.

    :param pixel: Flat index into (instants, height, width), (samples,).
    :param depth: Depth along the optical axis in metres, (samples,).
    :param material: Material, (samples,).
    :param face: Index into ``normal`` and ``vehicle``, (samples,).
    :param normal: Outward normals in the world frame, (faces, 2).
    :param vehicle: Number of the traffic vehicle or -1, (faces,).
    """

    pixel: NDArray[np.int64]
    depth: Array
    material: IntArray
    face: IntArray
    normal: Array
    vehicle: IntArray

    def last(self, instants: int, pixels: int) -> Objects:
        """
        Return the samples of the last instant, as if it had been rendered alone.

        :param instants: Number of instants.
        :param pixels: Pixels per instant.
        """
        first = (instants - 1) * pixels
        # The instants are sorted, though the pixels within each are not
        since = int(np.searchsorted(self.pixel, first))
        pixel, depth = self.pixel[since:] - first, self.depth[since:]
        return Objects(pixel, depth, self.material[since:], self.face[since:], self.normal, self.vehicle)


class Camera:
    """
    Pinhole camera 1 m ahead of the centre of the ego vehicle and 1.5 m above the road, looking along its heading.

    :param image_size: Rows and columns in pixels.
    :param shape: Shape of the road.
    :param field_of_view: Horizontal and vertical field of view in degrees.
    """

    offset = 1.0
    height = 1.5

    def __init__(self, image_size: int, shape: RoadShape, field_of_view: float = 60.0) -> None:
        self.size = image_size
        self.shape = shape
        self.roadside = Roadside(shape)
        # Only the fronts of oncoming cars are visible
        self._front = FRONT_LIT if shape.oncoming else FRONT
        self.focal = float(0.5 * image_size / np.tan(np.radians(field_of_view / 2)))
        self.centre = 0.5 * image_size
        # First image row that looks at the ground; with an odd number of rows the middle one looks at infinity
        self.horizon = image_size // 2 + image_size % 2
        # Tangent of the angle to the optical axis of every column (and row), of pixels and of samples
        self.slope = self._tangent(np.arange(image_size) + 0.5)
        self._sample_u = ((np.arange(SUPERSAMPLING * image_size) + 0.5) / SUPERSAMPLING).astype(np.float32)
        self._sample_slope = self._tangent(self._sample_u)
        # Distance of the ground in each row below the horizon [m], (rows, 1), and its offset to the right [m]
        self.ground_forward = np.float32(self.height) / self.slope[self.horizon :, None]
        self.ground_right = self.ground_forward * self.slope
        self.ground_view = GroundView(shape, self.ground_forward, self.ground_right, self.focal, self.height)

    def ground(self, poses: Array) -> Ground:
        """
        Render the ground.

        :param poses: x [m], y [m] and heading [rad], (instants, 1 + vehicles, 3); row 0 is the ego vehicle.
        """
        x, y, heading = (value.astype(np.float32)[:, None, None] for value in self._pose(poses, WORLD_PERIOD))
        return self.ground_view.look(x, y, heading)

    def objects(self, poses: Array, sizes: Array) -> Objects:
        """
        Render what stands on the ground.

        :param poses: As in :meth:`ground`.
        :param sizes: Length and width in metres, (1 + vehicles, 2).
        """
        faces = self._project(poses, sizes)
        side = SUPERSAMPLING * self.size
        painted = self._paint(len(poses), faces).reshape(-1)
        sample = np.flatnonzero(painted != 0)
        face = painted[sample].astype(np.int64) - 1
        # Line: row of the stacked images. Dividing by a constant is much faster in NumPy than taking a remainder.
        line = sample.astype(np.int32) // side
        column = sample - side * line
        pixel = line // SUPERSAMPLING * self.size + column // SUPERSAMPLING

        # Inverse depth, and s divided by depth, are linear along an image row
        u0, per_pixel, inverse, inverse_change, s, s_change, s_max, bottom, cells = faces.plane.take(face, axis=1)
        q = np.clip((self._sample_u[column] - u0) * per_pixel, 0, 1)
        depth = 1 / (inverse + q * inverse_change)
        cell_s = np.floor(TEXTURE_COLUMNS * np.minimum((s + q * s_change) * depth, s_max)).astype(np.int32)
        z = np.float32(self.height) - self._sample_slope.take(line, mode="wrap") * depth
        cell_z = np.clip((z - bottom) * cells, 0, TEXTURE_ROWS - 1).astype(np.int32)
        cell = (faces.kind.take(face) * TEXTURE_ROWS + cell_z) * TEXTURE_COLUMNS + cell_s % TEXTURE_COLUMNS
        material = TEXTURES.take(cell)
        body = np.flatnonzero(material == BODY)
        material[body] += faces.vehicle[face[body]]
        return Objects(pixel, depth, material, face, faces.normal, faces.vehicle)

    def depth(self, objects: Objects) -> Array:
        """
        Return the depth of one instant in metres along the optical axis, (height, width).

        It is that of the nearest object that a sample of the pixel hits, else that of the ground; infinite in the sky.

        :param objects: Objects of one instant.
        """
        depth = np.full((self.size, self.size), np.inf, dtype=np.float32)
        depth[self.horizon :] = self.ground_forward
        depth.reshape(-1)[objects.pixel] = np.inf
        np.minimum.at(depth.reshape(-1), objects.pixel, objects.depth)
        return depth

    def _tangent(self, pixels: Array) -> NDArray[np.float32]:
        return ((pixels - self.centre) / self.focal).astype(np.float32)

    def _pose(self, poses: Array, period: float = np.inf) -> tuple[Array, Array, Array]:
        """Position x (modulo a period) and y [m] and heading [rad] of the camera, (instants,) each."""
        x, y, heading = poses[:, 0].T
        x = x + self.offset * np.cos(heading)
        return x if period == np.inf else x % period, y + self.offset * np.sin(heading), heading

    def _project(self, poses: Array, sizes: Array) -> _Projected:
        """Faces that the camera sees, far to near at each instant."""
        x, y, heading = self._pose(poses)
        traffic = poses[:, 1:]
        forward, right = _to_camera(traffic[..., :2], x, y, heading)
        distance = np.hypot(forward, right)
        in_view = (forward > -5) & (forward < FAR + 5) & (np.abs(right) < 0.6 * forward + 12)
        shown = np.flatnonzero(in_view.any(axis=0))
        order = shown[np.argsort(-distance[:, shown], axis=1, kind="stable")]
        faces = Faces.concatenate(*self.roadside.faces(x, FAR), vehicle_faces(traffic, sizes[1:], order, self._front))

        # Both ends of the faces in the camera frame, (start and end, instants, faces)
        forward, right = _to_camera(np.stack((faces.start, faces.end)), x, y, heading)
        # Faces that are turned towards the camera have their start to the left of their end
        seen = forward[0] * right[1] > right[0] * forward[1]
        seen &= np.maximum(forward[0], forward[1]) > 2 * NEAR
        # Show vehicles at the instants at which they are in view, and the roadside always
        every = np.arange(len(poses))[:, None]
        seen[:, seen.shape[1] - 4 * len(shown) :] &= in_view[every, order].repeat(4, axis=1)
        face = np.flatnonzero(seen)
        if not self.shape.plain:
            far = self._remoteness(faces, face, np.hypot(forward, right), distance, traffic[..., 1])
            face = face[np.argsort(-far, kind="stable")]
        forward, right = (value.reshape(2, -1).take(face, axis=1) for value in (forward, right))
        instant, faces = face // seen.shape[1], faces.take(face)
        # (start and end; forward, right, place on the texture; faces)
        ends = np.stack((forward, right, (faces.s_start, faces.s_end)), axis=1)
        _clip_near(*ends)
        _clip_near(*ends[::-1])

        inverse = 1 / ends[:, 0]
        u, s = self.centre + self.focal * ends[:, 1] * inverse, ends[:, 2] * inverse
        bottom, top = BOTTOM.take(faces.kind), TOP.take(faces.kind)
        width = u[1] - u[0]
        tip = np.where(faces.kind == TREE, 0.5, 0.0) * width
        corners = np.empty((len(face), 4, 2))
        corners[:, :2, 0] = u.T
        corners[:, 2, 0], corners[:, 3, 0] = u[1] - tip, u[0] + tip
        corners[:, :2, 1] = (self.centre + self.focal * (self.height - bottom) * inverse).T
        corners[:, 3:1:-1, 1] = (self.centre + self.focal * (self.height - top) * inverse).T
        # Just below the end of the texture, so that a sample on the edge of a face falls into the last cell
        s_max = np.maximum(faces.s_start, faces.s_end) - 1e-4
        cells = TEXTURE_ROWS / (top - bottom)
        per_pixel = 1 / np.maximum(width, 1e-6)
        plane = np.array(
            (u[0], per_pixel, inverse[0], inverse[1] - inverse[0], s[0], s[1] - s[0], s_max, bottom, cells),
            dtype=np.float32,
        )
        return _Projected(instant, corners, plane, faces.kind, faces.normal, faces.vehicle)

    def _remoteness(self, faces: Faces, face: IntArray, ends: Array, middles: Array, y: Array) -> Array:
        """
        Distances by which to sort the faces of a road that bends or forks, where the roadside may hide vehicles.

        :param faces: All faces.
        :param face: Faces to sort, as indices into the flattened arrays.
        :param ends: Distance of both ends of all faces in metres, (2, instants, faces).
        :param middles: Distance of the centres of the vehicles in metres, (instants, vehicles).
        :param y: Position y of the vehicles in metres, (instants, vehicles).
        :return: Metres. Faces behind rails count as farther away than they are.
        """
        # A piece of rail counts by its farther end, and what stands behind it is farther still
        far = np.maximum(ends[0], ends[1]).take(face)
        place = 0.5 * (faces.start[..., 1].take(face) + faces.end[..., 1].take(face))
        vehicle = faces.vehicle.take(face)
        of_vehicle = np.flatnonzero(vehicle >= 0)
        shown = face[of_vehicle] // ends.shape[2], vehicle[of_vehicle]
        far[of_vehicle], place[of_vehicle] = middles[shown], y[shown]
        far += RAIL_PIECE * (self.roadside.behind_rail(place) + (faces.kind.take(face) == TREE))
        return np.asarray(far)

    def _paint(self, instants: int, faces: _Projected) -> NDArray[np.int32]:
        """Return the number (from 1) of the face of each sample, or 0 (instants, sample rows, sample columns)."""
        side = SUPERSAMPLING * self.size
        canvas = np.zeros((instants, side, side), dtype=np.int32)
        corners = faces.corners * SUPERSAMPLING - 0.5
        # OpenCV also paints the outline, half a sample on each side. A face always keeps one sample.
        corners -= np.clip(corners - corners.mean(axis=1, keepdims=True), -0.5, 0.5)
        polygons = np.rint(corners * 16).astype(np.int32)
        for number, (instant, polygon) in enumerate(zip(faces.instant.tolist(), polygons, strict=True), start=1):
            cv2.fillConvexPoly(canvas[instant], polygon, number, shift=4)
        return canvas


@dataclass
class _Projected:
    """
    Faces in the image, (faces, ...) each unless stated otherwise.

    :param instant: Instant.
    :param corners: u, v of the bottom left, bottom right, top right and top left corner, (faces, 4, 2).
    :param plane: u0, 1 / width, 1 / depth and its change, s / depth and its change, largest s, bottom [m] and cells per
        metre, (9, faces).
    :param kind: Kind of face.
    :param normal: Outward normal, (faces, 2).
    :param vehicle: Number of the traffic vehicle or -1.
    """

    instant: IntArray
    corners: Array
    plane: NDArray[np.float32]
    kind: IntArray
    normal: Array
    vehicle: IntArray


def _to_camera(points: Array, x: Array, y: Array, heading: Array) -> tuple[Array, Array]:
    """Forward and right [m] of world points (..., instants, n, 2) in the camera frame, (..., instants, n) each."""
    dx, dy = points[..., 0] - x[:, None], points[..., 1] - y[:, None]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    return cos * dx + sin * dy, cos * dy - sin * dx


def _clip_near(point: Array, other: Array) -> None:
    """
    Move the ends behind the near plane along their faces onto it.

    :param point: Forward [m], right [m] and place on the texture of one end, (3, faces). Modified in place.
    :param other: The same of the other end.
    """
    behind = np.flatnonzero(point[0] < NEAR)
    moved, towards = point[:, behind], other[:, behind] - point[:, behind]
    point[:, behind] = moved + (NEAR - moved[0]) / towards[0] * towards
