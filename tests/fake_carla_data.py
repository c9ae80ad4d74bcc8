"""What the fake CARLA server sends and lists: measurements that die with their callback, and blueprints."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping
from typing import Any

import carla
import numpy as np
from numpy.typing import NDArray

DVS_DTYPE = np.dtype([("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("pol", "?")])


def expect(value: Any, *kinds: type) -> None:
    """Boost.Python's strictness: numpy's float32 is no float and its integers are no int."""
    kinds = (*kinds, int) if float in kinds else kinds
    if not isinstance(value, kinds):
        raise TypeError(f"Python argument types did not match C++ signature: {type(value).__name__} for {kinds}")


# ---- measurements ----


class SensorData:
    def __init__(self, frame: int, timestamp: float, transform: carla.Transform) -> None:
        self._fields: dict[str, Any] = {"frame": frame, "timestamp": timestamp, "transform": transform}
        self._buffer = bytearray()
        self._dead = False

    def _get(self, name: str) -> Any:
        if self._dead:
            raise RuntimeError(f"{type(self).__name__}.{name} was read after the callback had returned")
        return self._fields[name]

    def _die(self) -> None:
        """What happens to the server's buffer once the callback has returned."""
        self._dead = True
        self._buffer[:] = b"\x5a" * len(self._buffer)

    @property
    def frame(self) -> int:
        return int(self._get("frame"))

    @property
    def timestamp(self) -> float:
        return float(self._get("timestamp"))

    @property
    def transform(self) -> Any:
        return self._get("transform")


class _Buffered(SensorData):
    def __init__(
        self, frame: int, timestamp: float, transform: carla.Transform, shape: tuple[int, int], fov: float, data: bytes
    ) -> None:
        super().__init__(frame, timestamp, transform)
        self._buffer = bytearray(data)
        self._fields.update(height=shape[0], width=shape[1], fov=fov, raw_data=memoryview(self._buffer).toreadonly())

    @property
    def height(self) -> int:
        return int(self._get("height"))

    @property
    def width(self) -> int:
        return int(self._get("width"))

    @property
    def fov(self) -> float:
        return float(self._get("fov"))

    @property
    def raw_data(self) -> memoryview:
        view = self._get("raw_data")
        assert isinstance(view, memoryview)
        return view


class Image(_Buffered):
    def __len__(self) -> int:
        return self.height * self.width


class DVSEventArray(_Buffered):
    def __len__(self) -> int:
        return len(self._buffer) // DVS_DTYPE.itemsize


class CollisionEvent(SensorData):
    def __init__(self, *sensor_data: Any, actor: Any, other_actor: Any, normal_impulse: carla.Vector3D) -> None:
        super().__init__(*sensor_data)
        self._fields.update(actor=actor, other_actor=other_actor, normal_impulse=normal_impulse)

    @property
    def actor(self) -> Any:
        return self._get("actor")

    @property
    def other_actor(self) -> Any:
        return self._get("other_actor")

    @property
    def normal_impulse(self) -> Any:
        return self._get("normal_impulse")


def depth_image(metres: NDArray[Any]) -> NDArray[np.uint8]:
    """The three bytes of CARLA's depth camera, (H, W, 4) in the order B, G, R, A; R holds the lowest byte."""
    code = np.round(metres / 1000 * (256**3 - 1)).astype(np.uint32)
    opaque = np.full_like(code, 255)
    return np.stack([code >> 16, code >> 8 & 255, code & 255, opaque], axis=-1).astype(np.uint8)


# ---- blueprints ----

_KINDS = {"Int": int, "Float": float}


class ActorAttribute:
    def __init__(self, name: str, kind: str, value: str, modifiable: bool = True) -> None:
        self._name, self._kind, self._value, self._modifiable = name, kind, value, modifiable

    @property
    def id(self) -> str:
        return self._name

    @property
    def type(self) -> Any:
        return getattr(carla.ActorAttributeType, self._kind)

    @property
    def is_modifiable(self) -> bool:
        return self._modifiable

    @property
    def recommended_values(self) -> list[str]:
        return [self._value]

    def as_int(self) -> int:
        return int(self._value)

    def as_float(self) -> float:
        return float(self._value)

    def as_str(self) -> str:
        return self._value

    def as_bool(self) -> bool:
        return self._value.lower() == "true"

    def __int__(self) -> int:
        return self.as_int()


class ActorBlueprint:
    def __init__(self, name: str, attributes: Mapping[str, ActorAttribute]) -> None:
        self._name, self._attributes = name, dict(attributes)

    @property
    def id(self) -> str:
        return self._name

    @property
    def tags(self) -> list[str]:
        return self._name.split(".")

    def has_tag(self, tag: str) -> bool:
        return tag in self.tags

    def has_attribute(self, id: str) -> bool:
        expect(id, str)
        return id in self._attributes

    def get_attribute(self, id: str) -> ActorAttribute:
        expect(id, str)
        if id not in self._attributes:
            raise IndexError(f"attribute '{id}' not found")
        return self._attributes[id]

    def set_attribute(self, id: str, value: str) -> None:
        attribute = self.get_attribute(id)
        expect(value, str)
        if not attribute.is_modifiable:
            raise ValueError("attribute is not modifiable")
        if attribute._kind == "Bool" and value.lower() not in ("true", "false"):
            raise ValueError("invalid attribute value")
        try:
            _KINDS.get(attribute._kind, str)(value)
        except ValueError:
            raise ValueError("invalid attribute value") from None
        self._attributes[id] = ActorAttribute(id, attribute._kind, value)

    def __iter__(self) -> Iterator[ActorAttribute]:
        return iter(self._attributes.values())

    def __len__(self) -> int:
        return len(self._attributes)


class BlueprintLibrary:
    def __init__(self, blueprints: list[ActorBlueprint]) -> None:
        self._blueprints = blueprints

    def find(self, id: str) -> ActorBlueprint:
        expect(id, str)
        for blueprint in self._blueprints:
            if blueprint.id == id:
                return ActorBlueprint(blueprint.id, blueprint._attributes)
        raise IndexError(f"blueprint '{id}' not found")

    def filter(self, wildcard_pattern: str) -> BlueprintLibrary:
        expect(wildcard_pattern, str)
        return BlueprintLibrary([b for b in self._blueprints if fnmatch.fnmatch(b.id, wildcard_pattern)])

    def __getitem__(self, pos: int) -> ActorBlueprint:
        return self.find(self._blueprints[pos].id)

    def __iter__(self) -> Iterator[ActorBlueprint]:
        return (self[k] for k in range(len(self)))

    def __len__(self) -> int:
        return len(self._blueprints)


def _table(text: str) -> dict[str, ActorAttribute]:
    """Attributes from lines "name kind default"."""
    return {name: ActorAttribute(name, kind, value) for name, kind, value in (line.split() for line in text.split(";"))}


_ROLE = "role_name String default"
_CAMERA = (
    f"{_ROLE};image_size_x Int 800;image_size_y Int 600;fov Float 90.0;sensor_tick Float 0.0;"
    "lens_circle_falloff Float 5.0;lens_circle_multiplier Float 0.0;lens_k Float -1.0;lens_kcube Float 0.0;"
    "lens_x_size Float 0.08;lens_y_size Float 0.08"
)
_LENS = (
    f"{_CAMERA};enable_postprocess_effects Bool true;exposure_mode String histogram;gamma Float 2.2;iso Float 100.0;"
    "motion_blur_intensity Float 0.45;shutter_speed Float 200.0;fstop Float 1.4"
)
_DVS = (
    f"{_LENS};positive_threshold Float 0.3;negative_threshold Float 0.3;sigma_positive_threshold Float 0.0;"
    "sigma_negative_threshold Float 0.0;refractory_period_ns Int 0;use_log Bool true;log_eps Float 0.001"
)
_SENSORS = {
    "sensor.camera.rgb": _LENS,
    "sensor.camera.depth": _CAMERA,
    "sensor.camera.dvs": _DVS,
    "sensor.other.collision": _ROLE,
    "sensor.other.lane_invasion": _ROLE,
}
_WHEELS = {
    "vehicle.audi.tt": 4,
    "vehicle.bmw.grandtourer": 4,
    "vehicle.carlamotors.firetruck": 4,
    "vehicle.gazelle.omafiets": 2,
    "vehicle.lincoln.mkz_2017": 4,
    "vehicle.nissan.patrol": 4,
    "vehicle.tesla.model3": 4,
    "vehicle.yamaha.yzf": 2,
}
_BASE_TYPES = {"carlamotors": "truck", "gazelle": "bicycle", "yamaha": "motorcycle"}


def blueprints() -> BlueprintLibrary:
    """The part of the library that a driving environment may ask for."""
    found = [ActorBlueprint(name, _table(text)) for name, text in _SENSORS.items()]
    for name, wheels in _WHEELS.items():
        attributes = _table(f"{_ROLE};sticky_control Bool true")
        if wheels == 4 and "carlamotors" not in name:  # not every vehicle can be painted
            attributes.update(_table("color RGBColor 255,0,0"))
        kind = _BASE_TYPES.get(name.split(".")[1], "car")
        for key, type_, value in [("number_of_wheels", "Int", str(wheels)), ("base_type", "String", kind)]:
            attributes[key] = ActorAttribute(key, type_, value, modifiable=False)
        found.append(ActorBlueprint(name, attributes))
    return BlueprintLibrary(found)
