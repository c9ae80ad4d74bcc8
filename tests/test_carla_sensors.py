"""Decoding and queues of CARLA's sensor data, without CARLA."""

import math
import queue
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sb3_have.envs.carla_vision.sensors import (
    DVS_DTYPE,
    Inbox,
    copy_events,
    copy_pixels,
    decode_depth,
    decode_rgb,
    event_image,
    event_options,
    impulse,
)

# ---- decoding ----


def test_rgb() -> None:
    pixels = np.zeros((2, 3, 4), dtype=np.uint8)
    pixels[0, 1] = (10, 20, 30, 255)  # blue, green, red, alpha
    decoded = decode_rgb(pixels)
    assert decoded.shape == (2, 3, 3) and decoded.flags.c_contiguous
    assert decoded[0, 1].tolist() == [30, 20, 10] and decoded.sum() == 60


@pytest.mark.parametrize(
    ("red", "green", "blue", "metres"),
    [
        (0, 0, 0, 0.0),
        (1, 0, 0, 1000 / 16777215),
        (0, 1, 0, 256000 / 16777215),
        (0, 0, 128, 500.00003),
        (254, 255, 255, 1000 * 16777214 / 16777215),
        (255, 255, 255, math.inf),
    ],
)
def test_depth(red: int, green: int, blue: int, metres: float) -> None:
    decoded = decode_depth(np.array([[[blue, green, red, 255]]], dtype=np.uint8))
    assert decoded.shape == (1, 1) and decoded.dtype == np.float32
    assert decoded[0, 0] == pytest.approx(metres, rel=1e-6)


def dvs(*events: tuple[int, int, int, bool]) -> NDArray[np.void]:
    return np.array(list(events), dtype=DVS_DTYPE)


def counts(*arrays: NDArray[np.void], start: int, size: int) -> NDArray[np.int64]:
    image = event_image(arrays, start, 0.2, size, event_options({"bins": 4}))
    assert image.dtype == np.uint8
    return image.astype(np.int64) - 128


def test_event_image() -> None:
    start = 37_250_000_000
    first = dvs((3, 1, start + 10_000_000, True), (0, 2, start + 50_000_001, False))
    image = counts(first, dvs((3, 1, start + 60_000_000, False)), start=start, size=4)
    assert image[1, 3].tolist() == [1, -1, 0, 0] and image[2, 0].tolist() == [0, -1, 0, 0]
    assert np.abs(image).sum() == 3 and not counts(start=start, size=4).any()


def test_event_image_keeps_events_that_rounding_puts_outside_of_the_step() -> None:
    start = int(1e9 * 0.1 * 3)  # 300000000.00000006 rounded down
    image = counts(dvs((0, 0, start - 1, True), (0, 0, start + 200_000_001, True)), start=start, size=1)
    assert image[0, 0].tolist() == [1, 0, 0, 1]


def test_callbacks_copy_the_buffer() -> None:
    buffer, stream = bytearray(range(24)), bytearray(dvs((7, 8, 9, True)).tobytes())
    pixels = copy_pixels(SimpleNamespace(raw_data=memoryview(buffer), width=3, height=2))
    events = copy_events(SimpleNamespace(raw_data=memoryview(stream)))
    buffer[:], stream[:] = bytes(len(buffer)), bytes(len(stream))
    assert pixels.shape == (2, 3, 4) and pixels[1, 2].tolist() == [20, 21, 22, 23]
    assert events.tolist() == [(7, 8, 9, True)]
    assert impulse(SimpleNamespace(normal_impulse=SimpleNamespace(x=2.0, y=-3.0, z=6.0))) == 7.0


# ---- queues ----


def inbox(*frames: int) -> Inbox[Any]:
    box = Inbox("rgb", lambda data: 10 * data.frame)
    for frame in frames:
        box(SimpleNamespace(frame=frame))
    return box


def test_at_skips_older_frames() -> None:
    assert inbox(3, 4, 5).at(5, 1.0) == 50


def test_at_waits() -> None:
    box = inbox()
    sender = threading.Timer(0.05, box, [SimpleNamespace(frame=5)])
    sender.start()
    assert box.at(5, 5.0) == 50
    sender.join()


def test_at_gives_up() -> None:
    with pytest.raises(TimeoutError, match=r"no data for frame 5 from the rgb sensor within 0.02 s"):
        inbox(4).at(5, 0.02)


def test_at_refuses_a_later_frame() -> None:
    with pytest.raises(RuntimeError, match="rgb sensor sent frame 6 instead of frame 5"):
        inbox(6).at(5, 1.0)


@pytest.mark.parametrize("read", [lambda box: box.at(5, 1.0), lambda box: box.drain()], ids=["at", "drain"])
def test_an_exception_in_the_callback_reaches_the_reader(read: Callable[[Inbox[Any]], Any]) -> None:
    box: Inbox[Any] = Inbox("depth", lambda data: 1 / 0)
    box(SimpleNamespace(frame=5))
    with pytest.raises(RuntimeError, match="callback of the depth sensor failed: ZeroDivisionError") as caught:
        read(box)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_drain_takes_everything() -> None:
    box = inbox(3, 3, 5)
    assert box.drain() == [(3, 30), (3, 30), (5, 50)]
    assert box.drain() == []


def test_drain_of_an_empty_inbox_returns() -> None:
    """In Python 3.10, a SimpleQueue waits forever in about one of 5,000 attempts."""
    reader = threading.Thread(target=lambda: [inbox().drain() for _ in range(30_000)], daemon=True)
    reader.start()
    reader.join(600)
    assert not reader.is_alive()


def test_drain_waits_for_the_frame_and_no_longer() -> None:
    class Items(queue.Queue[Any]):
        waits: list[float] = []  # noqa: RUF012

        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            assert timeout is not None
            self.waits.append(timeout)
            if len(self.waits) == 2:
                box(SimpleNamespace(frame=5))
            return super().get(block, min(timeout, 1.0))

    box = inbox()
    box._queue = Items()
    box(SimpleNamespace(frame=4))
    assert box.drain(5, 60.0) == [(4, 40), (5, 50)]
    assert len(Items.waits) == 3 and Items.waits[1] > 0 and Items.waits[2] == 0
    assert box.drain(6, 0.01) == []
