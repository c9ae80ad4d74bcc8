"""Measure memory and speed of ModalityReplayBuffer and SB3's DictReplayBuffer on stacked colour and event images.

    python -m benchmarks.replay_memory

Both buffers get the same random transitions, as from SB3's agents (three stacked frames, zeros after a reset, the
terminal observation at the end of an episode), and are filled beyond their size, so that old transitions are
overwritten. For each image size and episode length, the script prints and writes to
benchmarks/results/replay_memory.csv:

- ``bytes_per_transition``: growth of a new process's own memory (RssAnon on Linux) from before the buffer is created
  until some of it was overwritten, divided by the number of transitions it holds. Pages of "mmap" files do not count,
  because the system can write them back and drop them;
- ``held_per_transition``: size of all arrays in the buffer, including files and memory that was never touched;
- ``sample_*``: time of ``sample(batch_size)``, median and quartiles, with the contenders in turn;
- ``add_*``: time of ``add`` (one step of all environments) to the full buffer, median and quartiles;
- ``memory_vs_sb3`` (of the arrays), ``sample_vs_sb3``, ``add_vs_sb3``: how many times less memory and time than SB3.
  Ratios of times are medians over the rounds of the ratio within a round.

The buffers fit into the page cache. The cost of reading a "mmap" buffer that is larger than memory is not measured.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.measure import RESULTS, Row, interleave, machine, median_ratio, quartiles, save, show
from benchmarks.random_sensors import CHANNELS, make_env, transitions
from sb3_have import ModalityReplayBuffer

N_STACK = 3
MODALITIES = ("rgb", "event")
SB3 = "DictReplayBuffer"
BUFFERS: dict[str, tuple[Callable[..., ReplayBuffer], dict[str, Any]]] = {
    SB3: (DictReplayBuffer, {}),
    "ModalityReplayBuffer": (ModalityReplayBuffer, {"n_stack": N_STACK}),
    "ModalityReplayBuffer mmap": (ModalityReplayBuffer, {"n_stack": N_STACK, "storage": "mmap"}),
}
GROUP = ("image_size", "episode_length", "n_envs")


class Setting(NamedTuple):
    """Image size in pixels, episode length in steps, number of environments, size of the buffers in transitions."""

    image_size: int
    episode_length: int
    n_envs: int = 1
    transitions: int = 1000
    mmap_dir: str | None = None

    def env(self) -> VecEnv:
        channels = {key: CHANNELS[key] for key in MODALITIES}
        return make_env(channels, self.image_size, N_STACK, self.episode_length, self.n_envs)


def filled(name: str, setting: Setting) -> ReplayBuffer:
    """Create a buffer and add a quarter more transitions than it holds."""
    env = setting.env()
    buffer_class, kwargs = BUFFERS[name]
    if kwargs.get("storage") == "mmap":
        kwargs = {**kwargs, "mmap_dir": setting.mmap_dir}
    spaces_ = env.observation_space, env.action_space
    buffer = buffer_class(setting.transitions, *spaces_, device="cpu", n_envs=setting.n_envs, **kwargs)
    for transition in transitions(env, setting.transitions // setting.n_envs * 5 // 4):
        buffer.add(*transition)
    return buffer


def own_growth(name: str, setting: Setting) -> int | None:
    """Compute by how many bytes :func:`own_memory` grows when the buffer is created and filled."""
    filled(name, setting._replace(transitions=8))  # memory that the first use of the code takes is not the buffer's
    before = own_memory()
    buffer = filled(name, setting)
    after = own_memory()
    del buffer
    return None if before is None or after is None else after - before


def own_memory() -> int | None:
    """Get the bytes in memory of this process that belong to no file; None if the system does not report them."""
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) * 1024
    return None


def arrays(thing: object) -> Iterator[np.ndarray | th.Tensor]:
    """Iterate over all arrays of an object, in nested attributes, dicts and lists."""
    if isinstance(thing, (np.ndarray, th.Tensor)):
        yield thing
    elif isinstance(thing, Mapping):
        for value in thing.values():
            yield from arrays(value)
    elif isinstance(thing, (list, tuple)) and not all(isinstance(value, int) for value in thing):
        for value in thing:
            yield from arrays(value)
    elif hasattr(thing, "__dict__") and not isinstance(thing, (type, spaces.Space)):
        yield from arrays(vars(thing))


def measure(
    setting: Setting, names: Sequence[str] = tuple(BUFFERS), batch_size: int = 128, rounds: int = 50
) -> list[Row]:
    """
    Measure the buffers.

    :param setting: Images, episodes and size of the buffers
    :param names: Names of the buffers, including SB3's
    :param batch_size: Batch size of the samples
    :param rounds: Number of timed samples, and of timed additions, per buffer
    :return: One row per buffer
    """
    buffers = {name: filled(name, setting) for name in names}
    rows: dict[str, Row] = {}
    for name, buffer in buffers.items():
        with get_context("spawn").Pool(1) as fresh_process:  # a used one would fill free memory first
            growth = fresh_process.apply(own_growth, (name, setting))
        n_transitions = buffer.size() * setting.n_envs
        rows[name] = {
            "contender": name,
            "transitions": n_transitions,
            "bytes_per_transition": None if growth is None else round(growth / n_transitions),
            "held_per_transition": round(sum(array.nbytes for array in arrays(buffer)) / n_transitions),
        }
        rows[name]["memory_vs_sb3"] = round(rows[SB3]["held_per_transition"] / rows[name]["held_per_transition"], 2)

    warm_up = 5
    more = list(transitions(setting.env(), warm_up + rounds, seed=1))
    calls: dict[str, dict[str, Callable[[], object]]] = {
        "sample": {name: partial(buffer.sample, batch_size) for name, buffer in buffers.items()},
        "add": {name: partial(add_next, buffer, iter(more)) for name, buffer in buffers.items()},
    }
    for kind, by_name in calls.items():
        times = interleave(by_name, rounds, warm_up=warm_up)
        for name, row in rows.items():
            row.update(quartiles(times[name].wall, f"{kind}_"))
            row[f"{kind}_vs_sb3"] = round(median_ratio(times[SB3].wall, times[name].wall), 2)
    of_setting = {column: getattr(setting, column) for column in GROUP}
    return [{**of_setting, "batch_size": batch_size, **row} for row in rows.values()]


def add_next(buffer: ReplayBuffer, following: Iterator[tuple[Any, ...]]) -> None:
    buffer.add(*next(following))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64, 128])
    parser.add_argument("--episode-lengths", nargs="+", type=int, default=[1, 10, 100, 500])
    parser.add_argument("--n-envs", nargs="+", type=int, default=[1])
    parser.add_argument("--transitions", type=int, default=1000, help="size of the buffers")
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--mmap-dir", help="directory for the files of storage='mmap', on a disk")
    parser.add_argument("--output", type=Path, default=RESULTS / "replay_memory.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    about = machine()
    print(*about.values(), sep="\n")
    rows: list[Row] = []
    for image_size, length, n_envs in itertools.product(args.sizes, args.episode_lengths, args.n_envs):
        setting = Setting(image_size, length, n_envs, args.transitions, args.mmap_dir)
        measured = measure(setting, batch_size=args.batch_size, rounds=args.rounds)
        print(
            f"\n{image_size}x{image_size} px, {N_STACK} x {'+'.join(MODALITIES)}, episodes of {length} steps, "
            f"{n_envs} environment(s), batch {args.batch_size}"
        )
        show(measured, [column for column in measured[0] if column not in (*GROUP, "batch_size")])
        rows += [{**row, **about} for row in measured]
        save(rows, args.output, GROUP)


if __name__ == "__main__":
    main()
