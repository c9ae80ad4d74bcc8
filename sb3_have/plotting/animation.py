"""An episode as an animation: what the sensors saw, how the modalities were weighted, how it went."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from tqdm import tqdm

from sb3_have.checkpoint.files import write_atomically
from sb3_have.evaluation.recording import Recording
from sb3_have.plotting.episode import images
from sb3_have.plotting.style import modality_styles

LINE, GAP, CHART = 18, 4, 84
"""Heights of a line of text, a gap and the chart [px]."""
DASHES = {"-": (1,), "--": (1, 1, 1, 1, 1, 1, 0, 0, 0), "-.": (1, 1, 1, 1, 1, 0, 0, 1, 0, 0), ":": (1, 1, 0, 0)}
"""Pixels of a line that are drawn, over and over."""


class Frames:
    """The frames of an animation, drawn as they are asked for.

    From top to bottom: facts (weather, time, speed, distance, return so far, value), the sensors' images
    side by side, a bar for the weight of each modality, and the weights up to now as curves. The picture that
    ``render()`` gave stands before the images, if the recording has it.

    :param recording: to show
    :param width: of a frame [px]
    :raises ValueError: if the recording is empty
    """

    def __init__(self, recording: Recording, width: int = 640) -> None:
        if not recording.infos:
            raise ValueError("the recording is empty")
        if width < 120:
            raise ValueError(f"width={width}: expected 120 pixels or more")
        self.recording, self.width = recording, width - width % 2  # video codecs want even numbers
        self.styles = modality_styles(recording.weights)
        self.font = ImageFont.load_default(11 if width < 400 else 13)
        names = max(self.font.getlength(name) for name in ("100 %", *self.styles))
        self.left, self.right = (
            round(min(names, 0.4 * width)) + 12,
            self.width - round(self.font.getlength("100 %")) - 8,
        )
        self.returns: np.ndarray = np.cumsum(recording.rewards) - recording.rewards
        q = recording.values.get("q")
        self.q: np.ndarray | None = None if q is None else q.min(axis=0)
        tiles = self._tiles(0)
        aspect = sum(picture.shape[1] / picture.shape[0] for picture in tiles.values())
        self.tile: int = round(min((self.width - GAP * (len(tiles) - 1)) / aspect, 0.6 * self.width)) if tiles else 0
        facts = max(len(self._facts(step)) for step in range(len(self)))
        self._sensors = facts * LINE  # below the lines of facts
        self._top = self._sensors + (self.tile + LINE if tiles else 0) + GAP  # of the bars
        height = self._top + LINE * len(self.styles) + (CHART + 2 * GAP if self.styles else 0)
        self.size = self.width, height + height % 2
        self._chart = self._curves() if self.styles else None

    def __len__(self) -> int:
        return len(self.recording.infos)

    def __getitem__(self, step: int) -> Image.Image:
        frame = Image.new("RGB", self.size, "white")
        draw = ImageDraw.Draw(frame)
        for row, line in enumerate(self._facts(step)):
            draw.text((GAP, row * LINE + 1), line, fill="black", font=self.font)
        x = self._margin(step)
        for name, picture in self._tiles(step).items():
            width = round(self.tile * picture.shape[1] / picture.shape[0])
            method = Image.Resampling.NEAREST if self.tile > picture.shape[0] else Image.Resampling.BOX
            frame.paste(Image.fromarray(picture).resize((width, self.tile), method), (x, self._sensors + LINE))
            outline = (x, self._sensors + LINE, x + width - 1, self._sensors + LINE + self.tile - 1)
            draw.rectangle(outline, outline="#bbbbbb")  # an event camera that sees nothing is white
            draw.text((max(x, GAP), self._sensors), name, fill="#555555", font=self.font)
            x += width + GAP
        for row, (name, look) in enumerate(self.styles.items()):
            self._bar(draw, self._top + row * LINE, name, look.colour, float(self.recording.weights[name][step]))
        if self._chart is not None:
            self._draw_chart(frame, step)
        return frame

    def _tiles(self, step: int) -> dict[str, np.ndarray]:
        seen = images(self.recording.observations[step]) if self.recording.observations else {}
        return {"": self.recording.pictures[step], **seen} if self.recording.pictures else seen

    def _margin(self, step: int) -> int:
        """That centres the images."""
        widths: list[int] = [round(self.tile * tile.shape[1] / tile.shape[0]) for tile in self._tiles(step).values()]
        return max(0, (self.width - sum(widths) - GAP * (len(widths) - 1)) // 2)

    def _facts(self, step: int) -> list[str]:
        """In as many lines as the width makes necessary."""
        recording, info = self.recording, self.recording.infos[step]
        facts = [recording.weather] if recording.weather else []
        facts += [f"step {step}" if recording.seconds is None else f"{recording.times[step]:.1f} s"]
        facts += [f"{info['speed']:.0f} m/s"] if "speed" in info else []
        facts += [f"{info['distance']:.0f} m"] if "distance" in info else []
        facts += [f"return {_rounded(self.returns[step])}"] if len(self.returns) else []
        facts += [f"Q {_rounded(self.q[step])}"] if self.q is not None else []
        lines = facts[:1]
        for fact in facts[1:]:
            longer = f"{lines[-1]} | {fact}"
            if self.font.getlength(longer) <= self.width - 2 * GAP:
                lines[-1] = longer
            else:
                lines.append(fact)
        return lines

    def _bar(self, draw: ImageDraw.ImageDraw, top: int, name: str, colour: str, weight: float) -> None:
        draw.text((GAP, top), name, fill="black", font=self.font)
        draw.rectangle((self.left, top + 2, self.right, top + LINE - 4), fill="#eeeeee")
        if weight > 0:
            end = self.left + weight * (self.right - self.left)
            draw.rectangle((self.left, top + 2, end, top + LINE - 4), fill=colour)
        draw.text((self.right + 5, top), f"{100 * weight:.0f} %", fill="black", font=self.font)

    def _curves(self) -> Image.Image:
        """The weights over the whole episode, drawn at twice the size so that lines are smooth."""
        width, height = self.right - self.left, CHART
        chart = Image.new("RGB", (2 * width, 2 * height), "white")
        draw = ImageDraw.Draw(chart)
        columns = np.arange(width)
        for name, look in self.styles.items():
            at = np.interp(
                columns / max(1, width - 1) * (len(self) - 1), np.arange(len(self)), self.recording.weights[name]
            )
            heights, dashes = 2 * (1 - at) * (height - 3) + 2, DASHES[look.line]
            for x in columns[:-1]:
                if dashes[x % len(dashes)]:
                    draw.line((2 * x, heights[x], 2 * x + 2, heights[x + 1]), fill=look.colour, width=3)
        return chart.reduce(2)

    def _draw_chart(self, frame: Image.Image, step: int) -> None:
        assert self._chart is not None
        top, draw = self._top + LINE * len(self.styles) + GAP, ImageDraw.Draw(frame)
        now = round(step / max(1, len(self) - 1) * (self._chart.width - 1))
        frame.paste(self._chart.crop((0, 0, now + 1, CHART)), (self.left, top))
        draw.rectangle((self.left - 1, top - 1, self.right, top + CHART), outline="#bbbbbb")
        draw.line((self.left + now, top, self.left + now, top + CHART - 1), fill="#777777")
        draw.text((GAP, top - 2), "100 %", fill="#555555", font=self.font)
        draw.text((GAP, top + CHART - LINE + 3), "0", fill="#555555", font=self.font)


def _rounded(number: float) -> str:
    """To one digit, and never "-0.0"."""
    return f"{round(float(number), 1) + 0.0:.1f}"


def write_animation(
    recording: Recording, path: Path | str, fps: float | None = None, width: int = 640, progress_bar: bool = False
) -> None:
    """Every step of an episode as an ``.mp4`` video or a looped ``.gif``.

    An mp4 is H.264, which plays everywhere, where imageio-ffmpeg is installed (``pip install imageio-ffmpeg``), and
    VP9 by OpenCV else, which browsers and VLC play, but not every player of a desktop.

    :param recording: to show
    :param path: of the file; its ending decides
    :param fps: frames per second; by default as fast as it was, and 10 at least
    :param width: of the frames [px]
    :param progress_bar: shown per frame
    :raises ValueError: if the recording is empty or the ending is another
    """
    path = Path(path)
    writers = {".mp4": write_mp4, ".gif": _write_gif}
    if path.suffix.lower() not in writers:
        raise ValueError(f"{path}: expected a name that ends in {' or '.join(writers)}")
    frames = Frames(recording, width)
    if fps is None:
        fps = max(10.0, 1.0 / recording.seconds) if recording.seconds else 10.0
    with tqdm(total=len(frames), unit="frame", disable=not progress_bar) as bar:

        def drawn() -> Iterator[Image.Image]:
            for step in range(len(frames)):
                yield frames[step]
                bar.update()

        writers[path.suffix.lower()](path, drawn(), fps)


def write_mp4(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    """Write a video, see :func:`write_animation`.

    :param path: of the file
    :param frames: RGB, all of the same, even size
    :param fps: frames per second
    :raises OSError: if the file cannot be written
    """
    write: Callable[[Path, Iterator[Image.Image], float], None]
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        write = _write_by_opencv
    else:
        write = _write_by_ffmpeg
    unfinished = path.with_name(f"{path.stem}.partial.mp4")
    try:
        write(unfinished, frames, fps)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _write_by_ffmpeg(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    import imageio_ffmpeg

    first = next(frames)
    # sharp letters; the slower presets take twice the time for nothing that one sees here
    options = ["-preset", "veryfast", "-crf", "20", "-movflags", "+faststart"]
    writer = imageio_ffmpeg.write_frames(
        str(path), first.size, fps=fps, codec="libx264", quality=None, macro_block_size=2, output_params=options
    )
    writer.send(None)
    try:
        for frame in chain((first,), frames):
            writer.send(frame.tobytes())
    finally:
        writer.close()


def _write_by_opencv(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    first = next(frames)
    # OpenCV's wheels have no encoder for H.264; browsers do not play the mp4v that is common else
    for codec in ("vp09", "mp4v"):
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, first.size)
        if writer.isOpened():
            break
    else:
        raise OSError(f"OpenCV cannot write {path}: is its folder there, and writable? A .gif needs no codec")
    try:
        for frame in chain((first,), frames):
            writer.write(np.asarray(frame)[..., ::-1])
    finally:
        writer.release()


def _write_gif(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    _save_gif(path, list(frames), fps)


def write_gif(
    recording: Recording, path: Path | str, width: int = 480, max_frames: int = 100, max_bytes: int = 1_000_000
) -> None:
    """The episode as a small looped animation.

    :param recording: to show; 10 frames per second, which is at least twice the speed of HighwayVision-v0
    :param path: of the file
    :param width: of the animation [px]
    :param max_frames: every n-th step is shown so that there are no more
    :param max_bytes: frames are left out until the file is no larger
    :raises ValueError: if the recording is empty, or ``max_frames`` < 1
    """
    if max_frames < 1:
        raise ValueError(f"max_frames={max_frames}: expected 1 or more")
    frames = Frames(recording, width)
    stride = -(-len(frames) // max_frames)
    while True:
        shown = [frames[step] for step in range(0, len(frames), stride)]
        _save_gif(Path(path), shown, fps=10)
        if Path(path).stat().st_size <= max_bytes or len(shown) == 1:
            return
        stride *= 2


def _save_gif(path: Path, frames: list[Image.Image], fps: float) -> None:
    # one palette for all: the background does not flicker, and the file is smaller
    palette = Image.fromarray(np.concatenate([np.asarray(f) for f in frames[:: max(1, len(frames) // 8)]]))
    colours = palette.quantize(64)
    shown = [frame.quantize(palette=colours, dither=Image.Dither.NONE) for frame in frames]
    saved = partial(shown[0].save, format="GIF", save_all=True, append_images=shown[1:], loop=0, optimize=False)
    # [ms]; what is meant to be faster than 50 frames per second, browsers show at 10
    write_atomically(path, partial(saved, duration=max(20, round(1000 / fps))))
