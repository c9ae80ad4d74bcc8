"""Measure the first convolution of an encoder on pixels and on blocks of pixels (space to depth).

    python -m benchmarks.block_conv

An 8x8 convolution with stride 4 on 64x64 pixels computes the same sums as a 2x2 convolution with stride 1 on 16x16
blocks of 4x4 pixels. The batch has 64 images with the 9 and 15 channels of three stacked colour and event frames.
``sb3_have.common.encoders`` uses blocks on CPUs with AVX-512. The benchmark runs on one thread and times the forward
pass alone, as for the next observations, and forward and backward pass together. It prints and writes to
benchmarks/results/block_conv.csv the median and quartiles of the wall-clock time, and ``vs_pixels``, the median over
the rounds of the ratio to the time on pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

import torch as th

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from sb3_have.common.encoders import BlockConv2d

Contender = tuple[int, str, str, str]  # channels, precision, passes, layout


def forward(convolution: BlockConv2d, images: th.Tensor, dtype: th.dtype) -> th.Tensor:
    with th.autocast("cpu", dtype=dtype, enabled=dtype != th.float32):
        output: th.Tensor = convolution(images)
    return output


def forward_backward(convolution: BlockConv2d, images: th.Tensor, dtype: th.dtype) -> None:
    output = forward(convolution, images, dtype)
    output.backward(th.ones_like(output))  # type: ignore[no-untyped-call]


def contenders(channels: int, precision: str) -> dict[Contender, Callable[[], object]]:
    dtype = getattr(th, precision)
    convolution = BlockConv2d(channels, 32, 8, 4)
    convolution.to(memory_format=th.channels_last)  # type: ignore[call-overload]
    shapes = {"pixels": (64, channels, 64, 64), "blocks": (64, 16 * channels, 16, 16)}
    calls: dict[Contender, Callable[[], object]] = {}
    for layout, shape in shapes.items():
        images = th.rand(shape).to(dtype).contiguous(memory_format=th.channels_last)
        calls[channels, precision, "forward", layout] = th.no_grad()(partial(forward, convolution, images, dtype))
        calls[channels, precision, "forward and backward", layout] = partial(
            forward_backward, convolution, images, dtype
        )
    return calls


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--precisions", nargs="+", choices=("float32", "bfloat16"), default=["float32", "bfloat16"])
    parser.add_argument("--rounds", type=int, default=30)
    args = parser.parse_args()
    th.set_num_threads(1)
    calls = {
        contender: call
        for channels in (9, 15)
        for precision in args.precisions
        for contender, call in contenders(channels, precision).items()
    }
    times = interleave(calls, args.rounds, warm_up=3)
    rows: list[Row] = []
    for (channels, precision, passes, layout), (wall, _) in times.items():
        pixels = times[channels, precision, passes, "pixels"].wall
        about = {"channels": channels, "precision": precision, "passes": passes, "layout": layout}
        rows.append({**about, **quartiles(wall), "vs_pixels": round(median_ratio(wall, pixels), 3), **machine()})
    save(rows, RESULTS / "block_conv.csv", ("machine", "precision"))
    show(rows, ("channels", "precision", "passes", "layout", "median_ms", "q25_ms", "q75_ms", "vs_pixels"))


if __name__ == "__main__":
    main()
