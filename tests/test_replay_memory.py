"""What ModalityReplayBuffer takes of memory and disk, and which arguments it refuses."""

import gc
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from replay_reference import (
    FRAMES,
)

from sb3_have import ModalityReplayBuffer

# -- Memory

SIZE = 32


def image_buffer(buffer_size: int, n_stack: int = 3, n_envs: int = 1, **kwargs: Any) -> ModalityReplayBuffer:
    """Two keys of images, 8 channels and 8 KiB a frame together."""
    space = spaces.Dict(
        {key: spaces.Box(0, 255, (n_stack * FRAMES[key], SIZE, SIZE), np.uint8) for key in ("rgb", "event")}
    )
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    return ModalityReplayBuffer(buffer_size, space, action_space, "cpu", n_envs, n_stack=n_stack, **kwargs)


FRAME_BYTES = 8 * SIZE * SIZE


def play(buffer: ModalityReplayBuffer, lengths: list[int], padding: str = "zeros", seed: int = 0) -> int:
    """
    Episodes of ``lengths`` steps into the buffer, no frame like another.

    :return: transitions of each environment
    """
    rng = np.random.default_rng(seed)
    shapes = {key: box.shape for key, box in buffer.observation_space.items()}  # type: ignore[attr-defined]
    n_stack, n_envs = buffer.n_stack, buffer.n_envs

    def frames(n_frames: int) -> dict[str, np.ndarray]:
        return {
            key: rng.integers(1, 256, (n_envs, n_frames * shape[0] // n_stack, *shape[1:]), dtype=np.uint8)
            for key, shape in shapes.items()
        }

    for length in lengths:
        obs = frames(n_stack)
        for stack in obs.values():
            channels = stack.shape[1] // n_stack
            if padding == "zeros":
                stack[:, :-channels] = 0
            elif padding == "repeat":
                stack[:] = np.tile(stack[:, -channels:], (1, n_stack, 1, 1))
        for step in range(length):
            new = frames(1)
            next_obs = {key: np.concatenate([obs[key][:, new[key].shape[1] :], new[key]], axis=1) for key in obs}
            done = np.full(n_envs, step == length - 1)
            buffer.add(obs, next_obs, np.zeros((n_envs, 2)), np.zeros(n_envs), done, [{} for _ in range(n_envs)])
            obs = next_obs
    return sum(lengths)


def bytes_held(value: Any, seen: set[int] | None = None) -> int:
    """Bytes of the arrays and tensors that ``value`` holds anywhere, each once."""
    seen = set() if seen is None else seen
    while isinstance(value, np.ndarray) and isinstance(value.base, np.ndarray):
        value = value.base
    if id(value) in seen or isinstance(value, spaces.Space | str | type):
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray | th.Tensor):
        return int(value.nbytes)
    inside: list[Any] = []
    if isinstance(value, dict):
        inside = list(value.values())
    elif isinstance(value, list | tuple):
        inside = list(value)
    elif hasattr(value, "__dict__"):
        inside = list(vars(value).values())
    return sum(bytes_held(item, seen) for item in inside)


@pytest.mark.parametrize("padding", ["zeros", "repeat", "arbitrary"])
@pytest.mark.parametrize("n_stack", [1, 3, 4])
def test_one_frame_per_transition(n_stack: int, padding: str) -> None:
    """Long episodes: a frame of each key a transition, and a few at each reset. SB3 holds 2 n_stack of them."""
    n_transitions, episodes = 400, 4
    buffer = image_buffer(n_transitions, n_stack)
    play(buffer, [n_transitions // episodes] * episodes, padding)
    frames = n_transitions + episodes * (n_stack if padding == "arbitrary" else 1)
    tables = n_transitions * 256
    assert frames * FRAME_BYTES <= buffer.nbytes <= (frames + 8) * FRAME_BYTES + tables
    assert buffer.nbytes < 1.1 * n_transitions * FRAME_BYTES
    assert bytes_held(buffer) < 1.6 * n_transitions * FRAME_BYTES  # the pool may have room to spare


def test_several_environments_cost_the_same() -> None:
    buffer = image_buffer(400, n_envs=4)
    play(buffer, [100])
    assert buffer.size() == 100
    assert buffer.nbytes < 1.1 * 400 * FRAME_BYTES


def test_overwriting_frees_frames() -> None:
    buffer = image_buffer(50)
    lengths = [9, 1, 14, 3]
    play(buffer, lengths * 4)
    full, held_once = buffer.nbytes, bytes_held(buffer)
    for seed in range(10):
        play(buffer, lengths * 4, seed=seed)
        assert buffer.nbytes <= full + 3 * FRAME_BYTES
        assert bytes_held(buffer) == held_once


def test_many_wraps_leave_no_frame_behind() -> None:
    """After anything, 50 transitions of a long episode use as many frames as in a new buffer."""
    new, used = image_buffer(50), image_buffer(50)
    for seed in range(3):
        play(used, [1, 2, 1, 1, 30, 1, 1, 5] * 3, "arbitrary", seed)
    play(new, [75])
    play(used, [75])
    assert used.pool.n_used == new.pool.n_used == 54  # the oldest stack's 3, the next one of each, the one of zeros


@pytest.mark.parametrize("padding,frames", [("zeros", 2), ("repeat", 2), ("arbitrary", 4)])
def test_episodes_of_one_step(padding: str, frames: int) -> None:
    """All transitions are held; each costs its own frames, those before the end and the one after."""
    buffer = image_buffer(60)
    play(buffer, [1] * 150, padding)
    assert buffer.size() == 60
    assert 60 * frames * FRAME_BYTES <= buffer.nbytes <= (60 * frames + 6) * FRAME_BYTES + 60 * 256


def test_values_cost_one_copy_a_step() -> None:
    space = spaces.Dict({"vector": spaces.Box(-1.0, 1.0, (2048,), np.float32)})
    buffer = ModalityReplayBuffer(200, space, spaces.Box(-1.0, 1.0, (2,), np.float32), "cpu")
    rng = np.random.default_rng(0)
    obs = {"vector": rng.normal(size=(1, 2048)).astype(np.float32)}
    for _ in range(200):
        next_obs = {"vector": rng.normal(size=(1, 2048)).astype(np.float32)}
        buffer.add(obs, next_obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
        obs = next_obs
    assert buffer.nbytes < 1.1 * 200 * 2048 * 4


def test_pickle_holds_no_more_than_there_is() -> None:
    buffer = image_buffer(400)
    play(buffer, [20])
    assert len(pickle.dumps(buffer)) < 30 * FRAME_BYTES + 400 * 256


# -- Arguments


def make(**kwargs: Any) -> ModalityReplayBuffer:
    arguments: dict[str, Any] = {
        "buffer_size": 8,
        "observation_space": spaces.Dict({"rgb": spaces.Box(0, 255, (9, 16, 16), np.uint8)}),
        "action_space": spaces.Box(-1.0, 1.0, (2,), np.float32),
        "device": "cpu",
        **kwargs,
    }
    return ModalityReplayBuffer(**arguments)


@pytest.mark.parametrize(
    "arguments,words",
    [
        ({"storage": "disk"}, ["storage", "disk", "memory", "mmap", "device"]),
        ({"n_stack": 0}, ["n_stack", "0"]),
        ({"n_steps": 0}, ["n_steps", "0"]),
        ({"optimize_memory_usage": True}, ["optimize_memory_usage"]),
        ({"storage": "memory", "mmap_dir": "folder"}, ["mmap_dir", "folder", "storage", "memory"]),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        make(**arguments)
    for word in words:
        assert word in str(error.value)


def test_bad_arguments_beside_good_ones() -> None:
    make(n_stack=3, storage="memory", n_steps=3, gamma=0.5)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads Linux's list of mapped files")
def test_mmap_writes_where_it_is_told(tmp_path: Path) -> None:
    def mapped() -> bool:
        return str(tmp_path) in Path("/proc/self/maps").read_text()

    assert not mapped()
    buffer = make(n_stack=3, storage="mmap", mmap_dir=tmp_path)
    assert not mapped()  # nothing is reserved before there is something to store
    buffer.pool.take()
    assert mapped()
    del buffer
    gc.collect()
    assert not mapped()
    assert not list(tmp_path.iterdir())


def test_images_of_no_whole_number_of_frames_are_kept_whole() -> None:
    """As when a wrapper beyond VecFrameStack adds a channel."""
    buffer = make(observation_space=spaces.Dict({"rgb": spaces.Box(0, 255, (10, 16, 16), np.uint8)}), n_stack=3)
    assert buffer.stacked_keys == [] and buffer.pool.shapes["rgb"] == (10, 16, 16)
