"""
Sensors for any Gymnasium environment: simulated cameras, recorded events, and sensor failures.

What belongs here turns frames, depth or files into observations, or corrupts them. Scenes and driving belong to
:mod:`sb3_have.envs`, and networks to :mod:`sb3_have.common`.
"""

from sb3_have.sensors.depth import decode_depth, depth_from_zbuffer, disparity_noise, encode_depth
from sb3_have.sensors.depth_observation import DepthObservation
from sb3_have.sensors.event_camera import EVENT_DTYPE, PRESETS, EventCamera
from sb3_have.sensors.event_files import EventFile, read_events
from sb3_have.sensors.event_observation import EventObservation
from sb3_have.sensors.failures import FAILURES, SENSORS, failures_for
from sb3_have.sensors.rendering import RenderObservation
from sb3_have.sensors.representations import (
    Representation,
    channels,
    count_frames,
    decode_events,
    encode_events,
    polarity_counts,
    represent,
    stack_by_time,
    time_surface,
    voxel_grid,
)
from sb3_have.sensors.sensor_failure import SensorFailure
from sb3_have.sensors.wrappers import ChannelLastImages, DictObservation

__all__ = [
    "EVENT_DTYPE",
    "FAILURES",
    "PRESETS",
    "SENSORS",
    "ChannelLastImages",
    "DepthObservation",
    "DictObservation",
    "EventCamera",
    "EventFile",
    "EventObservation",
    "RenderObservation",
    "Representation",
    "SensorFailure",
    "channels",
    "count_frames",
    "decode_depth",
    "decode_events",
    "depth_from_zbuffer",
    "disparity_noise",
    "encode_depth",
    "encode_events",
    "failures_for",
    "polarity_counts",
    "read_events",
    "represent",
    "stack_by_time",
    "time_surface",
    "voxel_grid",
]
