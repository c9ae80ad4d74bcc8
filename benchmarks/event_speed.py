"""
Milliseconds per frame of the event camera on one thread.

    OMP_NUM_THREADS=1 python -m benchmarks.event_speed

The film is a texture of light that moves sideways in a loop by half a pixel per frame at 100 frames/s. At its contrast
an ideal camera of 128x128 pixels fires about 2,200 events per frame. The contenders take turns in one process. Rows,
printed and written to benchmarks/results/event_speed.csv, for each ``study``:

- ``setting``: cameras of 128x128 pixels, the presets and some of their parts;
- ``pixels``: an ideal camera of 64x64 to 512x512 pixels on the same texture, with proportionally many events;
- ``events``: an ideal camera of 128x128 pixels, contrast 1 to 8 times as high.

Columns: ``output``, "sorted" for ``EventCamera.step`` and "unsorted" for ``EventCamera.detect``, which is what an event
image is made from; ``events``, mean number a frame; median and quartiles of the wall-clock time of a frame (the mean
over a visit of one round of the film); ``cpu_ms``, median processor time, which is more reliable on a busy machine;
``ns_per_pixel`` and ``ns_per_event``, processor time over their number.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray

from benchmarks.measure import RESULTS, Row, interleave, machine, quartiles, save, show
from sb3_have.sensors import EventCamera

FRAMES = 64
FRAME_TIME = 0.01
# The texture repeats after this many columns, the film after FRAMES frames
TILE = 32
# Standard deviation of the log intensity at contrast 1
CONTRAST = 0.26

SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "ideal": ("ideal", {}),
    "ideal, mismatch": ("ideal", {"threshold_sigma": 0.05}),
    "ideal, refractory 1 ms": ("ideal", {"refractory": 1e-3}),
    "ideal, low-pass 30 Hz": ("ideal", {"cutoff_hz": 30.0}),
    "carla": ("carla", {}),
    "noisy": ("noisy", {}),
    "noisy, refractory 1 ms": ("noisy", {"refractory": 1e-3}),
}


class Contender(NamedTuple):
    """What is timed."""

    study: str
    setting: str = "ideal"
    image_size: int = 128
    contrast: int = 1
    output: str = "sorted"


def film(image_size: int, contrast: float, seed: int = 0) -> NDArray[np.float64]:
    """Frames of linear light around 0.3, (FRAMES, image_size, image_size); after the last comes the first."""
    rows, columns = np.fft.fftfreq(image_size)[:, None], np.fft.fftfreq(TILE)
    blur = np.exp(-(rows**2 + columns**2) * (TILE / 3) ** 2 / 2)
    spectrum = np.fft.fft2(np.random.default_rng(seed).standard_normal((image_size, TILE))) * blur
    shifts = np.arange(FRAMES)[:, None, None] * (TILE / FRAMES)
    texture = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * columns * shifts)).real
    texture = np.tile(texture / texture.std(), (1, 1, -(-image_size // TILE)))[..., :image_size]
    # Let the contrast grow across the image, because equal times in every repetition would be fast to sort
    log_light: NDArray[np.float64] = texture * np.linspace(0.7, 1.3, image_size) * contrast
    return np.asarray(0.3 * np.exp(log_light))


class Viewer:
    """A camera that watches the film in a loop; each call processes one frame and returns the number of its events."""

    def __init__(self, contender: Contender) -> None:
        preset, overrides = SETTINGS[contender.setting]
        size = contender.image_size
        self.camera = EventCamera.preset(preset, size, size, **{"seed": 0, **overrides})
        white = 255.0 if self.camera.mapping == "lin_log" else 1.0
        self.frames = list(film(size, CONTRAST * contender.contrast) * white)
        self.sorted = contender.output == "sorted"
        self.count = 0
        self()

    def __call__(self) -> int:
        frame, t = self.frames[self.count % FRAMES], self.count * FRAME_TIME
        self.count += 1
        return len(self.camera.step(frame, t)) if self.sorted else len(self.camera.detect(frame, t)[0])


def measure(contenders: Sequence[Contender], rounds: int = 30, repeats: int = FRAMES) -> list[Row]:
    """
    Return one row per contender.

    :param contenders: Cameras to time.
    :param rounds: Timed visits to each.
    :param repeats: Frames per visit.
    """
    viewers = {contender: Viewer(contender) for contender in contenders}
    events = {}
    for contender, viewer in viewers.items():
        for _ in range(FRAMES):  # until the film has passed every pixel once
            viewer()
        events[contender] = float(np.mean([viewer() for _ in range(FRAMES)]))
    rows: list[Row] = []
    for contender, (wall, cpu) in interleave(viewers, rounds, repeats).items():
        ns = float(np.median(cpu)) * 1e6
        row = {**contender._asdict(), "events": round(events[contender], 1), **quartiles(wall, digits=4)}
        row |= {"cpu_ms": round(ns / 1e6, 4), "ns_per_pixel": round(ns / contender.image_size**2, 2)}
        row |= {"ns_per_event": round(ns / events[contender], 1), "rounds": rounds, "frames": repeats}
        rows.append(row)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", nargs="+", choices=("setting", "pixels", "events"))
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of each contender in each round")
    parser.add_argument("--output", type=Path, default=RESULTS / "event_speed.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    about = machine()
    print(*about.values(), sep="\n")
    outputs = ("sorted", "unsorted")
    studies = {
        "setting": [Contender("setting", setting, output=output) for setting in SETTINGS for output in outputs],
        "pixels": [Contender("pixels", image_size=size, output=o) for size in (64, 128, 256, 512) for o in outputs],
        "events": [Contender("events", contrast=contrast, output=o) for contrast in (1, 2, 4, 8) for o in outputs],
    }
    for study in args.studies or studies:
        rows = measure(studies[study], args.rounds, args.frames)
        print(f"\n{study}, {args.rounds} x {args.frames} frames")
        show(rows, [column for column in rows[0] if column not in ("study", "rounds", "frames")])
        save([{**row, **about} for row in rows], args.output, ("study",))


if __name__ == "__main__":
    main()
