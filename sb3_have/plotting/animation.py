"""An episode as a film: what the sensors saw, the modality weights, speed, distance, return and value."""

from __future__ import annotations

from collections.abc import Iterator
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

# Heights of a line of text, a gap and the chart [px]
LINE, GAP, CHART = 18, 4, 84
# Repeating patterns of drawn pixels
DASHES = {"-": (1,), "--": (1, 1, 1, 1, 1, 1, 0, 0, 0), "-.": (1, 1, 1, 1, 1, 0, 0, 1, 0, 0), ":": (1, 1, 0, 0)}
# Maximum number of frames of a GIF by write_gif(), and frames per second
MAX_FRAMES, GIF_FPS = 100, 10


class Frames:
    """
    The frames of a film, drawn when they are indexed.

    From top to bottom: facts, the images of the sensors side by side, a bar for the weight of each modality, and the
    weights so far as curves. If the environment was rendered, its picture stands before the images.

    :param recording: Episode to show
    :param width: Width of a frame [px]
    """

    def __init__(self, recording: Recording, width: int = 640) -> None:
        if not recording.infos:
            raise ValueError("the recording is empty")
        if width < 120:
            raise ValueError(f"width={width}: expected at least 120 pixels")
        self.recording = recording
        self.width = width - width % 2  # video codecs require even numbers
        self.styles = modality_styles(recording.weights)
        self.font = ImageFont.load_default(11 if width < 400 else 13)
        self.returns: np.ndarray = np.cumsum(recording.rewards) - recording.rewards

        # Leave room for the names on the left of the bars and "100 %" on their right
        names = max(self.font.getlength(name) for name in ("100 %", *self.styles))
        self.left = round(min(names, 0.4 * width)) + 12
        self.right = self.width - round(self.font.getlength("100 %")) - 8

        # Scale the images to the same height, so that they fill the width
        tiles = self._tiles(0)
        aspects = [picture.shape[1] / picture.shape[0] for picture in tiles.values()]
        self.tile: int = 0
        if tiles:
            self.tile = round(min((self.width - GAP * (len(tiles) - 1)) / sum(aspects), 0.6 * self.width))
        self._widths: list[int] = [round(self.tile * aspect) for aspect in aspects]

        # Stack the facts, the images, the bars and the chart
        self._sensors = LINE * max(len(self._facts(step)) for step in range(len(self)))
        self._top = self._sensors + (self.tile + LINE if tiles else 0) + GAP
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
        self._draw_tiles(frame, draw, step)
        for row, (name, style) in enumerate(self.styles.items()):
            self._draw_bar(draw, self._top + row * LINE, name, style.colour, self.recording.weights[name][step])
        if self._chart is not None:
            self._draw_chart(frame, draw, self._chart, step)
        return frame

    def _tiles(self, step: int) -> dict[str, np.ndarray]:
        tiles = images(self.recording.observations[step]) if self.recording.observations else {}
        return {"": self.recording.pictures[step], **tiles} if self.recording.pictures else tiles

    def _facts(self, step: int) -> list[str]:
        """Return lines of facts that fit into the width."""
        recording, info = self.recording, self.recording.infos[step]
        facts = [recording.weather] if recording.weather else []
        facts.append(f"step {step}" if recording.seconds is None else f"{recording.times[step]:.1f} s")
        if "speed" in info:
            facts.append(f"{info['speed']:.0f} m/s")
        if "distance" in info:
            facts.append(f"{info['distance']:.0f} m")
        if len(self.returns):
            facts.append(f"return {_rounded(self.returns[step])}")
        if "q" in recording.values:
            facts.append(f"Q {_rounded(recording.values['q'][:, step].min())}")
        lines = facts[:1]
        for fact in facts[1:]:
            longer = f"{lines[-1]} | {fact}"
            if self.font.getlength(longer) <= self.width - 2 * GAP:
                lines[-1] = longer
            else:
                lines.append(fact)
        return lines

    def _draw_tiles(self, frame: Image.Image, draw: ImageDraw.ImageDraw, step: int) -> None:
        x = max(0, (self.width - sum(self._widths) - GAP * (len(self._widths) - 1)) // 2)
        top = self._sensors + LINE
        for width, (name, picture) in zip(self._widths, self._tiles(step).items(), strict=True):
            method = Image.Resampling.NEAREST if self.tile > picture.shape[0] else Image.Resampling.BOX
            frame.paste(Image.fromarray(picture).resize((width, self.tile), method), (x, top))
            # Without an outline, an event image without events is invisible
            draw.rectangle((x, top, x + width - 1, top + self.tile - 1), outline="#bbbbbb")
            draw.text((max(x, GAP), self._sensors), name, fill="#555555", font=self.font)
            x += width + GAP

    def _draw_bar(self, draw: ImageDraw.ImageDraw, top: int, name: str, colour: str, weight: float) -> None:
        draw.text((GAP, top), name, fill="black", font=self.font)
        draw.rectangle((self.left, top + 2, self.right, top + LINE - 4), fill="#eeeeee")
        if weight > 0:
            end = self.left + float(weight) * (self.right - self.left)
            draw.rectangle((self.left, top + 2, end, top + LINE - 4), fill=colour)
        draw.text((self.right + 5, top), f"{100 * weight:.0f} %", fill="black", font=self.font)

    def _curves(self) -> Image.Image:
        """Draw the weights over the whole episode, at twice the size to smooth the lines."""
        width = self.right - self.left
        chart = Image.new("RGB", (2 * width, 2 * CHART), "white")
        draw = ImageDraw.Draw(chart)
        columns = np.arange(width)
        steps = columns / max(1, width - 1) * (len(self) - 1)
        for name, style in self.styles.items():
            weights = np.interp(steps, np.arange(len(self)), self.recording.weights[name])
            heights, dashes = 2 * (1 - weights) * (CHART - 3) + 2, DASHES[style.line]
            for x in columns[:-1]:
                if dashes[x % len(dashes)]:
                    draw.line((2 * x, heights[x], 2 * x + 2, heights[x + 1]), fill=style.colour, width=3)
        return chart.reduce(2)

    def _draw_chart(self, frame: Image.Image, draw: ImageDraw.ImageDraw, chart: Image.Image, step: int) -> None:
        top = self._top + LINE * len(self.styles) + GAP
        now = round(step / max(1, len(self) - 1) * (chart.width - 1))
        frame.paste(chart.crop((0, 0, now + 1, CHART)), (self.left, top))
        draw.rectangle((self.left - 1, top - 1, self.right, top + CHART), outline="#bbbbbb")
        draw.line((self.left + now, top, self.left + now, top + CHART - 1), fill="#777777")
        draw.text((GAP, top - 2), "100 %", fill="#555555", font=self.font)
        draw.text((GAP, top + CHART - LINE + 3), "0", fill="#555555", font=self.font)


def _rounded(number: float) -> str:
    """Round to one digit, without "-0.0"."""
    return f"{round(float(number), 1) + 0.0:.1f}"


def write_animation(
    recording: Recording, path: Path | str, fps: float | None = None, width: int = 640, progress_bar: bool = False
) -> None:
    """
    Write every step of an episode as an ``.mp4`` video or a looped ``.gif``.

    With imageio-ffmpeg (``pip install "sb3_have[video]"``) an mp4 is H.264, which every player supports. Without it,
    OpenCV writes VP9, which browsers and VLC support.

    :param recording: Episode to show
    :param path: Name of the file, ending in .mp4 or .gif
    :param fps: Frames per second; by default real time, or 10 if the length of a step is unknown
    :param width: Width of the frames [px]
    :param progress_bar: Display a progress bar
    """
    path = Path(path)
    writers = {".mp4": write_mp4, ".gif": _write_gif}
    if path.suffix.lower() not in writers:
        raise ValueError(f"{path}: expected a name that ends in {' or '.join(writers)}")
    frames = Frames(recording, width)
    if fps is None:
        fps = 1.0 / recording.seconds if recording.seconds else GIF_FPS
    steps = tqdm(range(len(frames)), unit="frame", disable=not progress_bar)
    writers[path.suffix.lower()](path, (frames[step] for step in steps), fps)


def write_gif(recording: Recording, path: Path | str, width: int = 480, max_bytes: int = 1_000_000) -> None:
    """
    Write an episode as a small looped GIF, leaving out steps if it is long.

    It runs in real time, but at most at 10 frames per second.

    :param recording: Episode to show
    :param path: Name of the file
    :param width: Width of the frames [px]
    :param max_bytes: Largest size of the file
    """
    frames = Frames(recording, width)
    stride = -(-len(frames) // MAX_FRAMES)
    while True:
        shown = range(0, len(frames), stride)
        fps = min(GIF_FPS, 1.0 / (stride * recording.seconds)) if recording.seconds else GIF_FPS
        _write_gif(Path(path), (frames[step] for step in shown), fps)
        if Path(path).stat().st_size <= max_bytes or len(shown) == 1:
            return
        stride *= 2


def write_mp4(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    """
    Write frames as a video, see :func:`write_animation`.

    :param path: Name of the file
    :param frames: RGB images of the same, even size
    :param fps: Frames per second
    """
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        write = _write_with_opencv
    else:
        write = _write_with_ffmpeg
    # The ending of the unfinished file has to be mp4 as well
    unfinished = path.with_name(f"{path.stem}.partial.mp4")
    try:
        write(unfinished, frames, fps)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _write_with_ffmpeg(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    import imageio_ffmpeg

    first = next(frames)
    # Slower presets take twice the time without a visible difference
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


def _write_with_opencv(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    first = next(frames)
    # OpenCV's wheels cannot encode H.264, and browsers do not play mp4v
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), fps, first.size)
    if not writer.isOpened():
        raise OSError(f"OpenCV cannot write {path}: check the folder, or write a .gif")
    try:
        for frame in chain((first,), frames):
            writer.write(np.asarray(frame)[..., ::-1])
    finally:
        writer.release()


def _write_gif(path: Path, frames: Iterator[Image.Image], fps: float) -> None:
    drawn = list(frames)
    # The same palette for all frames keeps the background from flickering and the file small
    samples = np.concatenate([np.asarray(frame) for frame in drawn[:: max(1, len(drawn) // 8)]])
    palette = Image.fromarray(samples).quantize(64)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in drawn]
    # Browsers slow down GIFs with less than 20 ms per frame
    duration = max(20, round(1000 / fps))
    save = partial(first.save, format="GIF", save_all=True, append_images=others, loop=0, optimize=False)
    write_atomically(path, partial(save, duration=duration))
