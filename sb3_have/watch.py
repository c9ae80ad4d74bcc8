"""Film a trained model: an episode with what the sensors saw, the live weights of the modalities, speed and return.

    python -m sb3_have.watch runs/have-0 --weather HardRainNight --out drive.mp4

MODEL is a zip that SB3 saved, a checkpoint, or the folder of a run of ``python -m sb3_have.train``, whose settings then
tell the environment. Without them it is HighwayVision-v0 as in ``--config``, with the modalities and the image size
that the model reads; ``--env`` and ``--env-kwargs`` name another one. Statistics of ``VecNormalize`` are those of the
checkpoint, else of ``vecnormalize.pkl`` beside the model or where the Zoo puts it; a model's zip does not tell whether
it needs them. The ending of ``--out`` decides between mp4 and GIF.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gymnasium import spaces
from gymnasium.error import Error as GymnasiumError
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_have.algorithms import ALGORITHMS, saved_algorithm
from sb3_have.checkpoint.archive import DamagedCheckpointError
from sb3_have.checkpoint.checkpoint import checkpoint_info, checkpoints
from sb3_have.configuration import env_wrapper, hyperparameter, load_config
from sb3_have.envs.vision import MODALITIES
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.evaluation.wrapping import saved_normalizer
from sb3_have.plotting import write_animation

ENV_ID = "HighwayVision-v0"
CAMERAS = (ENV_ID, "CarlaVision-v0")
"""Environments with the keywords ``modalities`` and ``image_size``."""


def model_file(path: Path) -> Path:
    """The file that holds a model.

    :param path: a model, with or without the ending zip, a checkpoint, or a folder with ``model.zip`` or checkpoints
    :raises FileNotFoundError: if there is none
    """
    if path.is_dir():
        candidates = [path / "model.zip", *reversed(checkpoints(path))]
    else:
        candidates = [path, path.with_name(f"{path.name}.zip")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    looked = (
        f"{path / 'model.zip'} and {path / 'checkpoint-<step>'}"
        if path.is_dir()
        else " and ".join(map(str, candidates))
    )
    raise FileNotFoundError(f"there is no model: looked for {looked}")


def read_model(file: Path) -> tuple[io.BytesIO, dict[str, Any]]:
    """A model as SB3 saved it, and what is known of its training; nothing is unpickled.

    :param file: a model or a checkpoint
    :return: the model's zip; ``config``, ``env_id`` ... of the run of :mod:`sb3_have.train` that it is of, told by the
        checkpoint or by one beside its ``model.zip``, else empty
    :raises ValueError: if it is neither, or damaged
    """
    try:
        with zipfile.ZipFile(file) as archive:
            if "info.json" in archive.namelist():
                told = json.loads(archive.read("info.json"))
                return io.BytesIO(archive.read("model.zip")), dict(told.get("info", {}).get("settings", {}))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{file} is not a model that SB3's save() wrote, or it is damaged: {error}") from error
    # a model of another name may be of anywhere
    for checkpoint in reversed(checkpoints(file.parent) if file.name == "model.zip" else []):
        with suppress(DamagedCheckpointError):
            return io.BytesIO(file.read_bytes()), dict(checkpoint_info(checkpoint)["info"].get("settings", {}))
    return io.BytesIO(file.read_bytes()), {}


def load_model(file: Path, algo: str | None = None, device: str = "auto") -> tuple[BaseAlgorithm, dict[str, Any]]:
    """Load a model to watch it, with a small replay buffer.

    :param file: a model or a checkpoint; the model is unpickled, as SB3 does
    :param algo: name in :data:`sb3_have.algorithms.ALGORITHMS`; None is the one that saved it
    :param device: of the model
    :return: the model and the settings of its run, see :func:`read_model`
    :raises ValueError: if the file is no model, or of another algorithm
    """
    saved, settings = read_model(file)
    known = saved_algorithm(saved, file)
    name = algo or known or "havesac"
    if known is not None and name != known:
        raise ValueError(f"{file} was saved by {known}, not by {name}: leave --algo out")
    try:
        model = ALGORITHMS[name].load(saved, device=device, custom_objects={"buffer_size": 1000})
    except Exception as error:  # whatever a file of another kind makes SB3 stumble over
        raise ValueError(f"{file} cannot be loaded as {name}, give its --algo: {error!r}") from error
    return model, settings


def fitting_env_kwargs(space: spaces.Space[Any]) -> dict[str, Any]:
    """``modalities`` and ``image_size`` of a camera environment from the observation space of a model.

    :param space: of the model, images channel-first or -last
    :raises ValueError: if it has anything but images of the known modalities
    """
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
    shapes = [part.shape or () for part in parts.values()]
    if not set(parts) <= set(MODALITIES) or any(len(shape) != 3 for shape in shapes):
        raise ValueError(
            f"the model reads {', '.join(parts)}, not images of {', '.join(MODALITIES)}: "
            "give the environment that it was trained in by --env and --env-kwargs"
        )
    return {"modalities": [name for name in MODALITIES if name in parts], "image_size": sorted(shapes[0])[-1]}


def environment(
    model: BaseAlgorithm, settings: Mapping[str, Any], env_id: str | None, config: str
) -> tuple[str, dict[str, Any], Mapping[str, Any]]:
    """Where to drive a model.

    :param model: tells modalities and image size where nothing else does
    :param settings: of its run, may be empty
    :param env_id: to use in place of the run's
    :param config: configuration of ``zoo_configs`` for what the run does not tell
    :return: id, keywords, and the configuration with an ``env_wrapper``, if any
    """
    if settings and env_id in (None, settings["env_id"]):
        return settings["env_id"], dict(settings["config"].get("env_kwargs", {})), settings["config"]
    env_id = env_id or ENV_ID
    if env_id not in CAMERAS:
        return env_id, {}, {}
    defaults = load_config(config, env_id)
    return env_id, {**defaults.get("env_kwargs", {}), **fitting_env_kwargs(model.observation_space)}, defaults


def statistics_file(file: Path, env_id: str) -> Path | None:
    """Where the statistics of the ``VecNormalize`` of a model's training may be, None if nowhere.

    :param file: a model or a checkpoint
    :param env_id: of its environment, by which the Zoo calls the folder
    """
    with zipfile.ZipFile(file) as archive:
        if "state.pkl" in archive.namelist():
            return file
    candidates = [folder / "vecnormalize.pkl" for folder in (file.parent, file.parent / env_id)]
    return next(filter(Path.is_file, candidates), None)


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.watch``."""
    parser = argparse.ArgumentParser(prog="python -m sb3_have.watch", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "model", type=Path, metavar="MODEL", help="zip of a model, checkpoint, or folder of a training run"
    )
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help=".mp4 or .gif; default: %(default)s")
    parser.add_argument("--env", help=f"environment id; default: the run's, else {ENV_ID}")
    parser.add_argument(
        "--env-kwargs",
        nargs="+",
        default=[],
        type=hyperparameter,
        metavar="NAME:VALUE",
        help="keywords of the environment, in YAML: scenario:curves",
    )
    parser.add_argument("--weather", help="of the episode; default: as in training")
    parser.add_argument("--seed", type=int, default=0, help="of the episode")
    parser.add_argument("--steps", type=int, help="at most; default: the whole episode")
    parser.add_argument("--fps", type=float, help="frames per second; default: as fast as it was, at least 10")
    parser.add_argument("--width", type=int, default=640, help="of the picture [px]; default: %(default)s")
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="default: the one that saved the model")
    parser.add_argument(
        "--config", default="have", help="whose environment is used without a run's settings; default: %(default)s"
    )
    parser.add_argument(
        "--vecnormalize", type=Path, metavar="FILE", help="of VecNormalize.save(); default: vecnormalize.pkl, if any"
    )
    parser.add_argument("--stochastic", action="store_true", help="sample the actions rather than take their mode")
    parser.add_argument("--device", default="auto")
    args = parser.parse_args(arguments)
    if args.steps is not None and args.steps < 1:
        parser.error(f"--steps {args.steps}: expected 1 or more")
    if args.fps is not None and args.fps <= 0:
        parser.error(f"--fps {args.fps}: expected a number above 0")
    if args.out.suffix.lower() not in (".mp4", ".gif"):
        parser.error(f"--out {args.out}: expected a name that ends in .mp4 or .gif")
    try:
        recording = watch(args)
    except KeyboardInterrupt:
        print("\nInterrupted; nothing was written.", file=sys.stderr)
        sys.exit(130)
    except (OSError, KeyError, ValueError, TypeError, GymnasiumError) as error:
        parser.error(str(error.args[0] if isinstance(error, KeyError) else error))
    distance = recording.end.get("distance")
    told = f", {distance:.0f} m" if distance is not None else ""
    print(f"{args.out}: {len(recording.infos)} steps, return {recording.rewards.sum():.1f}{told}")


def watch(args: argparse.Namespace) -> Recording:
    """Drive the episode and write its film; arguments as in :func:`main`."""
    args.out.parent.mkdir(parents=True, exist_ok=True)
    file = model_file(args.model)
    model, settings = load_model(file, args.algo, args.device)
    env_id, env_kwargs, config = environment(model, settings, args.env, args.config)
    env_kwargs |= dict(args.env_kwargs) | ({} if args.weather is None else {"weather": args.weather})
    statistics = args.vecnormalize or statistics_file(file, env_id)
    normalizer = None if statistics is None else saved_normalizer(statistics)
    told = "" if normalizer is None else f", observations normalised as in {statistics}"
    print(f"{env_id} {env_kwargs}{told}")
    recording = record_episode(
        model,
        env_id,
        seed=args.seed,
        env_kwargs=env_kwargs,
        max_steps=args.steps,
        env_wrapper=env_wrapper(config),
        deterministic=not args.stochastic,
        render=env_id not in CAMERAS,  # there the picture is that of the sensors
        progress_bar=True,
        normalizer=normalizer,
    )
    write_animation(recording, args.out, args.fps, args.width, progress_bar=True)
    return recording


if __name__ == "__main__":
    main()
