"""From what CARLA's sensors send to images: decoding and queues. No CARLA here."""

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
    copy_image,
    decode_depth_image,
    decode_dvs,
    decode_rgb,
    impulse,
)
from sb3_have.sensors import EVENT_DTYPE, stack_by_time

# ---- decoding ----


def test_colours_come_in_the_order_red_green_blue() -> None:
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
        (0, 0, 1, 65536000 / 16777215),
        (0, 0, 128, 500.00003),
        (254, 255, 255, 1000 * 16777214 / 16777215),
        (255, 255, 255, math.inf),
    ],
)
def test_depth_by_hand(red: int, green: int, blue: int, metres: float) -> None:
    pixels = np.array([[[blue, green, red, 255]]], dtype=np.uint8)
    decoded = decode_depth_image(pixels)
    assert decoded.shape == (1, 1) and decoded.dtype == np.float32
    assert decoded[0, 0] == pytest.approx(metres, rel=1e-6)


def dvs(*events: tuple[int, int, int, bool]) -> NDArray[np.void]:
    return np.array(list(events), dtype=DVS_DTYPE)


def test_events_keep_their_places_and_get_times_of_the_step() -> None:
    start = 37_250_000_000
    first = dvs((3, 1, start + 10_000_000, True), (0, 2, start + 50_000_000, False))
    second = dvs((3, 1, start + 60_000_000, False))
    events = decode_dvs([first, second], start, 0.2)
    assert events.dtype == EVENT_DTYPE
    assert events["x"].tolist() == [3, 0, 3] and events["y"].tolist() == [1, 2, 1]
    np.testing.assert_allclose(events["t"], [0.01, 0.05, 0.06], atol=1e-12)
    assert events["p"].tolist() == [1, -1, -1]
    image = stack_by_time(events, 4, 0.0, 0.2, 4, 5)
    assert image[1, 3].tolist() == [1, -1, 0, 0] and image[2, 0].tolist() == [0, -1, 0, 0]


def test_rounding_to_nanoseconds_loses_no_event() -> None:
    start = int(1e9 * 0.1 * 3)  # 300000000.00000006 rounded down
    events = decode_dvs([dvs((0, 0, start - 1, True), (0, 0, start + 200_000_001, True))], start, 0.2)
    assert stack_by_time(events, 5, 0.0, 0.2, 1, 1)[0, 0].tolist() == [1, 0, 0, 0, 1]
    assert len(decode_dvs([], start, 0.2)) == 0


def test_what_the_callbacks_copy() -> None:
    buffer = bytearray(range(24))
    image = SimpleNamespace(raw_data=memoryview(buffer), width=3, height=2)
    pixels = copy_image(image)
    stream = bytearray(dvs((7, 8, 9, True)).tobytes())
    events = copy_events(SimpleNamespace(raw_data=memoryview(stream)))
    for index in range(len(buffer)):
        buffer[index] = 0  # CARLA reuses its buffers
    stream[:] = bytes(len(stream))
    assert pixels.shape == (2, 3, 4) and pixels[1, 2].tolist() == [20, 21, 22, 23]
    assert events.tolist() == [(7, 8, 9, True)]
    assert impulse(SimpleNamespace(normal_impulse=SimpleNamespace(x=2.0, y=-3.0, z=6.0))) == 7.0


# ---- queues ----


def data(frame: int, value: Any = None) -> Any:
    return SimpleNamespace(frame=frame, value=value)


def inbox() -> Inbox[Any]:
    return Inbox("rgb", lambda data: data.value)


def test_an_image_of_the_frame_is_found_behind_older_ones() -> None:
    box = inbox()
    for frame in (3, 4, 5):
        box(data(frame, 10 * frame))
    assert box.at(5, 1.0) == 50


def test_an_image_may_come_later() -> None:
    box = inbox()
    sender = threading.Timer(0.05, box, [data(5, "late")])
    sender.start()
    assert box.at(5, 5.0) == "late"
    sender.join()


def test_an_image_that_does_not_come() -> None:
    box = inbox()
    box(data(4))
    with pytest.raises(TimeoutError, match=r"no data of frame 5 from the rgb sensor within 0.02 s .* raise `timeout`"):
        box.at(5, 0.02)


def test_an_image_of_a_later_frame_means_somebody_else_ticks() -> None:
    box = inbox()
    box(data(6))
    with pytest.raises(RuntimeError, match="rgb sensor sent frame 6 when frame 5 was due"):
        box.at(5, 1.0)


def test_an_exception_in_a_callback_is_raised_where_the_data_is_read() -> None:
    reads: tuple[Callable[[Inbox[Any]], Any], ...] = (lambda box: box.at(5, 1.0), lambda box: box.drain())
    for read in reads:
        box: Inbox[Any] = Inbox("depth", lambda data: 1 / 0)
        box(data(5))  # CARLA would swallow it here
        with pytest.raises(RuntimeError, match="callback of the depth sensor failed: ZeroDivisionError") as caught:
            read(box)
        assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_all_that_has_come_is_drained_with_its_frames() -> None:
    box = inbox()
    assert box.drain() == []
    for frame in (3, 3, 5):
        box(data(frame, frame))
    assert box.drain() == [(3, 3), (3, 3), (5, 5)]
    assert box.drain() == []


def test_draining_waits_for_the_frame_and_no_longer() -> None:
    class Items(queue.SimpleQueue[Any]):
        waits: list[float] = []  # noqa: RUF012

        def get(self, block: bool = True, timeout: float | None = None) -> Any:
            assert timeout is not None
            self.waits.append(timeout)
            if len(self.waits) == 2:
                box(data(5, "new"))
            return super().get(block, min(timeout, 1.0))

    box = inbox()
    box._items = Items()
    box(data(4, "old"))
    assert box.drain(5, 60.0) == [(4, "old"), (5, "new")]
    assert len(Items.waits) == 3 and Items.waits[1] > 0 and Items.waits[2] == 0
    assert box.drain(6, 0.01) == []
