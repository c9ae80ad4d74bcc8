"""Measure a gradient step of HAVESAC, compared with SB3's SAC with equal encoders and with the encoders alone.

    python -m benchmarks.update_speed                               # everything; --shapes a is the quick part
    python -m benchmarks.update_speed --shapes b --device cuda      # on a GPU

There are two shapes with three stacked frames: (a) 64x64 px, the Nature encoder, batch 64; (b) 128x128 px, the paper's
encoder, batch 128. The modalities are the first 1, 2, 3 or 5 of colour, events, depth and two more colour cameras. The
contenders take turns in one process, on one thread by default. The unit is one ``train(gradient_steps=1)``, including
sampling, with updates of critics, actor, temperature and target. The script prints and writes to
benchmarks/results/update_speed.csv:

- ``SB3 SAC``: MultiInputPolicy with DictReplayBuffer and encoders with the same layers for each key, separate for each
  network; ``SB3 SAC shared``: the same with ``share_features_extractor=True``;
- ``HAVESAC``: its defaults in the given precision; ``HAVESAC no auxiliary``: without DeepMDP;
- ``encoders``: HAVESAC's encoders alone, forward and backward on observations and forward on next_observations, both
  already decoded: the lower bound of a step in that precision;
- ``sampling`` and ``decoding`` (bytes to floats): the other parts of the step before the encoders;
- ``rest``: the step without these three: heads, losses, optimizers, target updates;
- ``heads``: the same measured separately, as a step of HAVESAC on vectors instead of encoded images. ``rest`` also
  includes the encoders' share of optimizer and target update, and cache misses caused by the images.

The columns are median and quartiles of the wall-clock time; ``cpu_ms``, the median processor time; ``vs_sb3`` and
``vs_sb3_shared``, how many times faster than SB3; ``vs_floor``, the time divided by that of the encoders; and
``share``, the share of HAVESAC's step. Ratios are medians over the rounds of the ratio within a round. On a GPU,
``gpu_share`` is the time of the kernels divided by the time of the step. ``options`` are the command line options that
change what is measured. With ``--retain-memory`` the C library keeps freed memory, because page faults slow all
contenders down with large images.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import DictReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from torch import nn

from benchmarks.measure import (
    RESULTS,
    Row,
    Times,
    interleave,
    machine,
    median_ratio,
    quartiles,
    save,
    show,
)
from benchmarks.random_sensors import CHANNELS, make_env, transitions
from sb3_have import HAVESAC
from sb3_have.common.encoders import MultiModalEncoder, default_layers
from sb3_have.common.memory import keep_freed_memory

FEATURES_DIM = 50
NET_ARCH = [256, 256]
BUFFER_SIZE = 500
GROUP = ("machine", "device", "threads", "options", "shape", "modalities")
RATIOS = ("vs_sb3", "vs_sb3_shared", "vs_floor", "share")
COLUMNS = {"contender", "precision", "median_ms", "q25_ms", "q75_ms", "cpu_ms", *RATIOS, "updates_per_s", "gpu_share"}
PARTS = ("encoders", "decoding", "sampling")
Step = Callable[[], object]
Contender = tuple[str, str]  # name, precision


class Shape(NamedTuple):
    """Image size in pixels, batch size, default number of rounds and default numbers of modalities."""

    image_size: int
    batch_size: int
    rounds: int
    modalities: tuple[int, ...]


SHAPES = {"a": Shape(64, 64, 30, (1, 2, 3, 5)), "b": Shape(128, 128, 7, (2,))}


class PlainEncoders(BaseFeaturesExtractor):
    """HAVESAC's default encoders as an SB3 user would write them: the same layers for each key, concatenated."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, FEATURES_DIM * len(observation_space.spaces))
        self.encoders = nn.ModuleDict({key: plain_encoder(space) for key, space in observation_space.spaces.items()})

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([encoder(observations[key]) for key, encoder in self.encoders.items()], dim=1)


def plain_encoder(space: spaces.Space[Any]) -> nn.Sequential:
    assert space.shape is not None
    channels, height, width = space.shape
    layers: list[nn.Module] = []
    for filters, kernel_size, stride in default_layers(min(height, width)):
        layers += [nn.Conv2d(channels, filters, kernel_size, stride), nn.ReLU()]
        channels = filters
    layers += [nn.Flatten()]
    n_flatten = nn.Sequential(*layers)(th.zeros(1, *space.shape)).shape[1]
    return nn.Sequential(*layers, nn.Linear(n_flatten, FEATURES_DIM), nn.LayerNorm(FEATURES_DIM))


def sb3_sac(env: VecEnv, share_features_extractor: bool, device: str) -> SAC:
    policy_kwargs = {
        "net_arch": NET_ARCH,
        "features_extractor_class": PlainEncoders,
        "share_features_extractor": share_features_extractor,
    }
    return SAC("MultiInputPolicy", env, buffer_size=BUFFER_SIZE, policy_kwargs=policy_kwargs, seed=0, device=device)


def have_sac(env: VecEnv, precision: str, device: str, encoder_classes: Any = None, **kwargs: Any) -> HAVESAC:
    policy_kwargs = {
        "net_arch": NET_ARCH,
        "features_dim": FEATURES_DIM,
        "precision": precision,
        "encoder_classes": encoder_classes,
    }
    return HAVESAC(
        "MultiInputPolicy", env, buffer_size=BUFFER_SIZE, policy_kwargs=policy_kwargs, seed=0, device=device, **kwargs
    )


def ready(models: Sequence[SAC], env: VecEnv) -> None:
    """Fill the first model's replay buffer and share it, so that all models train on the same data."""
    buffer = models[0].replay_buffer
    assert buffer is not None
    for transition in transitions(env, BUFFER_SIZE):
        buffer.add(*transition)
    for model in models:
        model.replay_buffer = buffer
        model.set_logger(configure(None, []))


class NormOnly(nn.LayerNorm):
    """Replacement for an encoder when only the parts after it are timed."""

    def __init__(self, observation_space: spaces.Box, features_dim: int):
        super().__init__(features_dim)


class Features(gym.Env[Any, Any]):
    """The spaces of an environment whose observations are features."""

    def __init__(self, modalities: int):
        box = spaces.Box(-np.inf, np.inf, (FEATURES_DIM,), np.float32)
        self.observation_space = spaces.Dict({f"z_{i}": box for i in range(modalities)})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)


def heads_alone(modalities: int, batch_size: int, device: str, compile: bool = False) -> Step:
    """Create a step of HAVESAC on features: heads, losses, and their share of optimizer and target update."""
    env = DummyVecEnv([lambda: Features(modalities)])
    keys = [f"z_{i}" for i in range(modalities)]
    model = have_sac(env, "float32", device, encoder_classes=dict.fromkeys(keys, NormOnly), compile=compile)
    buffer = model.replay_buffer
    assert isinstance(buffer, DictReplayBuffer)
    rng = np.random.default_rng(0)
    for _ in range(BUFFER_SIZE):
        observations, following = ({key: rng.normal(size=(1, FEATURES_DIM)) for key in keys} for _ in range(2))
        buffer.add(observations, following, rng.uniform(-1, 1, (1, 2)), rng.normal(size=1), np.zeros(1), [{}])
    model.set_logger(configure(None, []))
    return lambda: model.train(gradient_steps=1, batch_size=batch_size)


class NoEncoder(nn.Module):
    """Replacement for an encoder when only the parts before it are timed."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return inputs.new_zeros(len(inputs), FEATURES_DIM)


def parts(model: HAVESAC, batch_size: int) -> dict[str, Step]:
    """Create the parts of a step up to the encoders."""
    buffer = model.replay_buffer
    assert buffer is not None
    batch = buffer.sample(batch_size)
    assert isinstance(batch, DictReplayBufferSamples)
    return {
        "encoders": encoders_alone(model, batch),
        "decoding": decoding(model.critic.encoder, batch),
        "sampling": lambda: buffer.sample(batch_size),
    }


def decoding(encoder: MultiModalEncoder, batch: DictReplayBufferSamples) -> Step:
    """Create the step that decodes raw observations for the encoders of the modalities."""
    decoder = copy.deepcopy(encoder)
    decoder.encoders = nn.ModuleList(NoEncoder() for _ in encoder.encoders)

    @th.no_grad()
    def step() -> None:
        decoder(batch.observations)
        decoder(batch.next_observations)

    return step


def encoders_alone(model: HAVESAC, batch: DictReplayBufferSamples) -> Step:
    """Create the step that trains the encoders on decoded observations and applies them to next_observations."""
    encode = on_decoded(model.critic.encoder, batch.observations)
    encode_next = on_decoded(model.critic_target.encoder, batch.next_observations)
    gradient = th.ones_like(encode())

    def step() -> None:
        model.critic.encoder.zero_grad()
        encode().backward(gradient)  # type: ignore[no-untyped-call]
        with th.no_grad():
            encode_next()

    return step


def on_decoded(encoder: MultiModalEncoder, observations: dict[str, th.Tensor]) -> Callable[[], th.Tensor]:
    """
    Create a function that computes the features (B, d, F) from inputs that are already decoded.

    :param encoder: Encoder whose modalities' encoders are called, with the same autocast
    :param observations: Raw observations
    :return: The function
    """
    calls: list[tuple[nn.Module, th.Tensor, bool, th.dtype]] = []

    def remember(module: nn.Module, inputs: tuple[th.Tensor, ...]) -> None:
        device = inputs[0].device.type
        autocast = th.is_autocast_enabled(device), th.get_autocast_dtype(device)
        calls.append((module, inputs[0].detach().clone(), *autocast))

    hooks = [module.register_forward_pre_hook(remember) for module in encoder.encoders]
    with th.no_grad():
        encoder.forward(observations)  # a compiled forward may not call the hooks
    for hook in hooks:
        hook.remove()

    def encode() -> th.Tensor:
        features = []
        for module, inputs, enabled, dtype in calls:
            with th.autocast(inputs.device.type, dtype=dtype, enabled=enabled):
                features.append(module(inputs))
        return th.stack([values.float() for values in features], dim=1)

    return encode


def kernel_ms(step: Step, repeats: int = 10) -> float:
    """Measure the milliseconds that a GPU spends in kernels for one step, without copies between host and GPU."""
    with th.profiler.profile(activities=[th.profiler.ProfilerActivity.CUDA]) as profiler:
        for _ in range(repeats):
            step()
        th.cuda.synchronize()
    microseconds = sum(
        event.time_range.elapsed_us()
        for event in profiler.events() or []
        if event.device_type.name == "CUDA"
        and not event.name.startswith(("Memcpy", "Memset"))
        and not getattr(event, "is_user_annotation", False)
    )
    return float(microseconds) / 1e3 / repeats


def measure(
    shape: Shape,
    modalities: int,
    precisions: Sequence[str] = ("float32", "bfloat16"),
    rounds: int | None = None,
    with_sb3: bool = True,
    device: str = "cpu",
    **kwargs: Any,
) -> list[Row]:
    """
    Measure all contenders.

    :param shape: Shape of the images and the batch
    :param modalities: Number of modalities
    :param precisions: Precisions of HAVESAC's encoders
    :param rounds: Number of timed steps of each contender; on a GPU each is the mean of ten steps
    :param with_sb3: Whether to measure SB3's SAC
    :param device: "cpu" or "cuda"
    :param kwargs: Arguments of HAVESAC
    :return: One row per contender and part
    """
    env = make_env(dict(list(CHANNELS.items())[:modalities]), shape.image_size)
    have = {
        (name, precision): have_sac(env, precision, device, **{**kwargs, **options})
        for precision in precisions
        for name, options in (("HAVESAC", {}), ("HAVESAC no auxiliary", {"auxiliary": None}))
    }
    ready(list(have.values()), env)
    sb3 = {}
    if with_sb3:
        sb3 = {
            ("SB3 SAC", "float32"): sb3_sac(env, False, device),
            ("SB3 SAC shared", "float32"): sb3_sac(env, True, device),
        }
        ready(list(sb3.values()), env)

    def update(model: SAC) -> Step:
        return lambda: model.train(gradient_steps=1, batch_size=shape.batch_size)

    steps: dict[Contender, Step] = {contender: update(model) for contender, model in {**sb3, **have}.items()}
    for precision in precisions:
        for part, step in parts(have["HAVESAC", precision], shape.batch_size).items():
            steps[part, precision] = step
    heads = heads_alone(modalities, shape.batch_size, device, kwargs.get("compile", False))
    steps.update({("heads", precision): heads for precision in precisions})  # float32 in any case

    rounds = rounds or shape.rounds
    repeats = 1 if device == "cpu" else 10
    times = interleave(steps, rounds, repeats, warm_up=max(1, rounds // 10))
    rows = summary(times, precisions)
    if device != "cpu":
        for row in rows:
            row["updates_per_s"] = round(1e3 / row["median_ms"], 1)
            contender = row["contender"], row["precision"]
            row["gpu_share"] = round(kernel_ms(steps[contender]) / row["median_ms"], 3) if contender in steps else None
    settings: Row = {
        "device": device,
        "threads": th.get_num_threads(),
        "image_size": shape.image_size,
        "batch_size": shape.batch_size,
        "modalities": modalities,
        "rounds": rounds,
    }
    return [{**settings, **row} for row in rows]


def summary(measured: Mapping[Contender, Times], precisions: Sequence[str]) -> list[Row]:
    """Create the rows of all contenders, and of the rest of HAVESAC's step by subtraction within a round."""
    times = dict(measured)
    for precision in precisions:
        step, *known = (times[name, precision] for name in ("HAVESAC", *PARTS))
        rest = [whole - np.sum(spent, axis=0) for whole, *spent in zip(step, *known, strict=True)]
        times["rest", precision] = Times(*rest)
    rows = []
    for (name, precision), (wall, cpu) in times.items():
        row: Row = {"contender": name, "precision": precision, **quartiles(wall)}
        row["cpu_ms"] = round(float(np.median(cpu)), 3)
        row.update(dict.fromkeys(RATIOS))
        if name.startswith("HAVESAC"):
            for column, peer in (("vs_sb3", "SB3 SAC"), ("vs_sb3_shared", "SB3 SAC shared")):
                if (peer, "float32") in times:
                    row[column] = round(median_ratio(times[peer, "float32"].wall, wall), 2)
            row["vs_floor"] = round(median_ratio(wall, times["encoders", precision].wall), 3)
        elif not name.startswith("SB3"):
            row["share"] = round(median_ratio(wall, times["HAVESAC", precision].wall), 3)
        rows.append(row)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", nargs="+", choices=list(SHAPES), default=list(SHAPES))
    parser.add_argument("--modalities", nargs="+", type=int, choices=range(1, 6), help="default: 1 2 3 5 at a, 2 at b")
    parser.add_argument("--precisions", nargs="+", choices=("float32", "bfloat16"), default=["float32", "bfloat16"])
    parser.add_argument("--batch-size", type=int, help="default: 64 at a, 128 at b")
    parser.add_argument("--rounds", type=int, help="default: 30 at a, 7 at b")
    parser.add_argument("--skip-sb3", action="store_true")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--retain-memory", action="store_true", help="let malloc keep freed memory, for all contenders")
    parser.add_argument("--storage", help="storage of HAVESAC's replay buffer: memory, mmap or device")
    parser.add_argument("--compile", action="store_true", help="use HAVESAC(compile=True)")
    parser.add_argument("--output", type=Path, default=RESULTS / "update_speed.csv")
    args = parser.parse_args(arguments)
    th.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)  # decodes HAVESAC's images
    kwargs: dict[str, Any] = {}
    options = "default"
    if args.compile:
        kwargs["compile"] = True
        options += " compile"
    if args.storage:
        kwargs["replay_buffer_kwargs"] = {"storage": args.storage}
        options += f" storage={args.storage}"
    if args.batch_size:
        options += f" batch-size={args.batch_size}"
    if args.retain_memory:
        if not keep_freed_memory():
            parser.error("--retain-memory: the C library has no mallopt")
        options += " retain-memory"
    about = machine(args.device)
    print(*about.values(), f"{args.threads} thread(s), options: {options}", sep="\n")
    rows: list[Row] = []
    for name in args.shapes:
        shape = SHAPES[name]
        if args.batch_size:
            shape = shape._replace(batch_size=args.batch_size)
        for modalities in args.modalities or shape.modalities:
            measured = measure(
                shape, modalities, args.precisions, args.rounds, not args.skip_sb3, args.device, **kwargs
            )
            keys = ", ".join(list(CHANNELS)[:modalities])
            print(f"\n({name}) {shape.image_size}x{shape.image_size} px, {keys}; batch {shape.batch_size}")
            show(measured, [column for column in measured[0] if column in COLUMNS])
            rows += [{"shape": name, "options": options, **row, **about} for row in measured]
            save(rows, args.output, GROUP)


if __name__ == "__main__":
    main()
