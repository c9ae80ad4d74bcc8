"""An episode as a page for a browser, in which a person moves through the steps."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sb3_have.checkpoint.files import write_atomically
from sb3_have.evaluation.recording import Recording
from sb3_have.plotting.episode import images, value_curves
from sb3_have.plotting.style import CURVES, Style, modality_styles

TEMPLATE = Path(__file__).with_name("page.html")
# Largest side of a picture in the page [px]
LARGEST = 320
# Quality of the pictures that are not stored without loss, of 100
QUALITY = 80
# Size of a file up to which the best quality is chosen [bytes]; 500 steps of three sensors are then 6 MB in Base64
BUDGET = 3000

Curve = tuple[str, Style, float, np.ndarray]


def write_page(recording: Recording, path: Path | str, actions: Sequence[str] = ()) -> None:
    """
    Write an episode as one HTML file, which needs neither a network nor a server.

    The page shows the images of the sensors side by side with the weight of each modality, and the weights, the value
    and its parts, the speed, the actions and the reward as curves. What the recording does not have is left out. An
    ``<iframe>`` of the same site is given the height of the page.

    :param recording: Episode to show
    :param path: Name of the file
    :param actions: Names of the A entries of an action. Each of them gets its own panel. By default they are
        "action 0", "action 1" and so on, in one panel.
    :raises ValueError: If the recording is empty, or if there are more or fewer names than entries
    """
    if not recording.infos:
        raise ValueError("the recording is empty")
    episode = {
        "weather": recording.weather,
        "facts": _facts(recording),
        "seconds": recording.seconds,
        "steps": len(recording.infos),
        "images": _images(recording),
        "panels": _panels(recording, actions),
    }
    # An unescaped "</script>" would end the block of data
    data = json.dumps(episode, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = TEMPLATE.read_text(encoding="utf-8").replace("EPISODE", data)
    write_atomically(Path(path), lambda unfinished: unfinished.write_text(page, encoding="utf-8"))


def _facts(recording: Recording) -> dict[str, str]:
    steps = len(recording.infos)
    facts = {"steps" if recording.seconds is None else "duration": f"{steps}"}
    if recording.seconds is not None:
        facts["duration"] = f"{steps * recording.seconds:.1f} s"
    if "distance" in recording.end:
        facts["distance"] = f"{recording.end['distance']:.0f} m"
    if len(recording.rewards):
        facts["return"] = f"{recording.rewards.sum():.1f}"
    if recording.end.get("end_reason"):
        facts["end"] = str(recording.end["end_reason"])
    return facts


def _images(recording: Recording) -> list[dict[str, Any]]:
    """Return name, width, height and the WebP files, in Base64, of each image."""
    seen = [images(observation) for observation in recording.observations]
    series = {name: [pictures[name] for pictures in seen] for name in (seen[0] if seen else {})}
    if recording.pictures:
        series = {"environment": recording.pictures, **series}
    return [
        {"name": name, "width": frames[0].shape[1], "height": frames[0].shape[0], "frames": [*map(_encode, frames)]}
        for name, frames in series.items()
    ]


def _encode(picture: np.ndarray) -> str:
    """Return the best WebP file within the budget in Base64, or the smallest one."""
    image = Image.fromarray(picture)
    has_few_colours = image.getcolors(256) is not None
    image.thumbnail((LARGEST, LARGEST), Image.Resampling.BOX)
    # WebP stores the colours at half the resolution, so pixels keep theirs in a picture of twice the size
    doubled = image.resize((2 * image.width, 2 * image.height), Image.Resampling.NEAREST)
    files = [_webp(doubled, quality=QUALITY), _webp(image, quality=QUALITY)]
    # Events and depth are mostly smaller without loss, noise is not
    if has_few_colours:
        files.insert(0, _webp(image, lossless=True))
    best = next((file for file in files if len(file) <= BUDGET), min(files, key=len))
    return base64.b64encode(best).decode()


def _webp(image: Image.Image, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, "WEBP", **options)
    return file.getvalue()


def _panels(recording: Recording, actions: Sequence[str]) -> list[dict[str, Any]]:
    panels = []
    if recording.weights:
        weights = [
            (name, style, 1.5, 100 * recording.weights[name])
            for name, style in modality_styles(recording.weights).items()
        ]
        panels.append(_panel("weight of each modality", weights, "%", (0, 100)))
    if "q" in recording.values:
        panels.append(_panel("value of the action", value_curves(recording)))
    if any("speed" in info for info in recording.infos):
        speeds = np.array([info.get("speed", np.nan) for info in recording.infos])
        panels.append(_panel("speed", [_single(speeds)], "m/s", (0,)))
    entries = recording.actions.reshape(len(recording.infos), -1).T
    if actions and len(actions) != len(entries):
        raise ValueError(f"actions: expected {len(entries)} names, got {list(actions)}")
    if actions:
        for name, entry in zip(actions, entries, strict=True):
            panels.append(_panel(name, [_single(entry)], include=(0,)))
    elif entries.size:
        curves = [(f"action {i}", CURVES[i % len(CURVES)], 1.5, entry) for i, entry in enumerate(entries)]
        panels.append(_panel("action", curves, include=(0,)))
    if len(recording.rewards):
        panels.append(_panel("reward", [_single(recording.rewards)], include=(0,)))
    return panels


def _single(values: np.ndarray) -> Curve:
    return "", CURVES[0], 1.5, values


def _panel(title: str, curves: Iterable[Curve], unit: str = "", include: Sequence[float] = ()) -> dict[str, Any]:
    """
    Return a panel with the numbers as the page shows them, rounded to 1/300 of their range or finer.

    :param include: Values that the axis contains
    """
    curves = list(curves)
    numbers = np.concatenate([*(values for *_, values in curves), np.asarray(include, float)])
    numbers = numbers[np.isfinite(numbers)]
    low, high = (float(numbers.min()), float(numbers.max())) if len(numbers) else (0.0, 1.0)
    digits = int(np.clip(np.ceil(np.log10(300 / (high - low or 1.0))), 0, 6))
    drawn = [
        {"label": label, "colour": style.colour, "line": style.line, "width": width, "values": _rounded(values, digits)}
        for label, style, width, values in curves
    ]
    return {"title": title, "unit": unit, "digits": digits, "low": low, "high": high, "curves": drawn}


def _rounded(values: np.ndarray, digits: int) -> list[float | None]:
    """Round without "-0.0", and replace what JSON does not have by None."""
    return [round(float(value), digits) + 0.0 if np.isfinite(value) else None for value in values]
