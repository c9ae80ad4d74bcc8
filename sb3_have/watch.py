"""
Film a trained model: an episode with the sensors' images, the modality weights, speed, distance, return and value.

    python -m sb3_have.watch runs/have-0 --weather HardRainNight --out drive.mp4

MODEL is a zip that SB3 saved, a checkpoint, the folder of a run of ``python -m sb3_have.train``, or the name of a
trained driver that comes with the package: ``have`` or ``have-depth``. Your own model or run of the same name takes
precedence, and ``./have`` never means the trained driver. The settings of a run include its environment. Without them
it is HighwayVision-v0 as in ``--config``, with the modalities and the image size of the model, unless ``--env`` and
``--env-kwargs`` name another one. The statistics of ``VecNormalize`` are read from the checkpoint, or from
``vecnormalize.pkl`` beside the model or where the Zoo saves it; the zip does not show whether they are needed.
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
from sb3_have.configuration import env_wrapper, hyperparameter, load_config, suggest
from sb3_have.envs.vision import MODALITIES
from sb3_have.evaluation.episodes import Predictor
from sb3_have.evaluation.recording import Recording, record_episode
from sb3_have.evaluation.wrapping import saved_normalizer
from sb3_have.plotting import write_animation, write_page
from sb3_have.trained import driver_names, pretrained

ENV_ID = "HighwayVision-v0"
# Environments with the keywords `modalities` and `image_size`
CAMERAS = (ENV_ID, "CarlaVision-v0")
# Names of their actions
ACTIONS = ("throttle (negative brakes)", "steering (positive turns right)")


def model_file(name: str | Path) -> Path:
    """
    Find the file of a model.

    :param name: A model, with or without the ending zip, a checkpoint, or a folder with ``model.zip`` or checkpoints
    """
    path = Path(name)
    if path.is_dir():
        candidates = [path / "model.zip", *reversed(checkpoints(path))]
    else:
        candidates = [path, path.with_name(f"{path.name}.zip")]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise FileNotFoundError(
        f"{name} is neither a model, nor a folder with model.zip or checkpoints, nor a trained driver"
        + suggest(str(name), driver_names())
    )


def read_model(file: Path) -> tuple[io.BytesIO, dict[str, Any]]:
    """
    Read a model and the settings of its run without unpickling anything.

    :param file: A model or a checkpoint
    :return: The zip of the model, and ``env_id``, ``config`` and so on if :mod:`sb3_have.train` trained it; they are
        in the checkpoint, or in one beside ``model.zip``
    """
    try:
        with zipfile.ZipFile(file) as archive:
            if "info.json" in archive.namelist():
                info = json.loads(archive.read("info.json"))
                return io.BytesIO(archive.read("model.zip")), dict(info.get("info", {}).get("settings", {}))
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{file} is not a model that SB3 saved, or it is damaged: {error}") from error
    # A model with another name may not belong to the run
    for checkpoint in reversed(checkpoints(file.parent) if file.name == "model.zip" else []):
        with suppress(DamagedCheckpointError):
            return io.BytesIO(file.read_bytes()), dict(checkpoint_info(checkpoint)["info"].get("settings", {}))
    return io.BytesIO(file.read_bytes()), {}


def load_model(file: Path, algo: str | None = None, device: str = "auto") -> tuple[BaseAlgorithm, dict[str, Any]]:
    """
    Load a model with a small replay buffer. This unpickles the file, as SB3 does.

    :param file: A model or a checkpoint
    :param algo: Name of the algorithm; by default the one that saved the model
    :param device: Device of the model
    :return: The model and the settings of its run, see :func:`read_model`
    """
    saved, settings = read_model(file)
    known = saved_algorithm(saved, file)
    name = algo or known or "havesac"
    if known not in (None, name):
        raise ValueError(f"{file} was saved by {known}, not by {name}: leave out --algo")
    try:
        model = ALGORITHMS[name].load(saved, device=device, custom_objects={"buffer_size": 1000})
    except Exception as error:  # whatever SB3 raises for a file of another kind
        raise ValueError(f"{file} cannot be loaded as {name}, try --algo: {error!r}") from error
    return model, settings


def fitting_env_kwargs(space: spaces.Space[Any]) -> dict[str, Any]:
    """
    Return the ``modalities`` and the ``image_size`` of a camera environment that a model can be driven in.

    :param space: Observation space of the model
    """
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {"observation": space}
    shapes = [part.shape or () for part in parts.values()]
    if not set(parts) <= set(MODALITIES) or any(len(shape) != 3 for shape in shapes):
        raise ValueError(
            f"the model reads {', '.join(parts)} instead of images of {', '.join(MODALITIES)}: name the environment "
            "that it was trained in with --env and --env-kwargs"
        )
    return {"modalities": [name for name in MODALITIES if name in parts], "image_size": sorted(shapes[0])[-1]}


def environment(
    model: BaseAlgorithm, settings: Mapping[str, Any], env_id: str | None, config: str
) -> tuple[str, dict[str, Any], Mapping[str, Any]]:
    """
    Choose the environment to drive a model in.

    :param model: The model
    :param settings: Settings of its run, if known
    :param env_id: Replaces the environment of the run
    :param config: Configuration that has the environment if the settings do not
    :return: Environment id, keyword arguments, and a configuration that may have an ``env_wrapper``
    """
    if settings and env_id in (None, settings["env_id"]):
        return settings["env_id"], dict(settings["config"].get("env_kwargs", {})), settings["config"]
    env_id = env_id or ENV_ID
    if env_id not in CAMERAS:
        return env_id, {}, {}
    defaults = load_config(config, env_id)
    return env_id, {**defaults.get("env_kwargs", {}), **fitting_env_kwargs(model.observation_space)}, defaults


def statistics_file(file: Path, env_id: str) -> Path | None:
    """
    Find the statistics of ``VecNormalize``.

    :param file: A model or a checkpoint
    :param env_id: Its environment, after which the Zoo names a folder
    """
    with zipfile.ZipFile(file) as archive:
        if "state.pkl" in archive.namelist():
            return file
    candidates = [folder / "vecnormalize.pkl" for folder in (file.parent, file.parent / env_id)]
    return next(filter(Path.is_file, candidates), None)


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.watch``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.watch", description=(__doc__ or "").strip().splitlines()[0]
    )
    parser.add_argument(
        "model",
        metavar="MODEL",
        help="zip of a model, checkpoint, folder of a training run, or a trained driver: "
        f"{', '.join(driver_names())}. Your own model or run of the same name takes precedence; ./have never means the "
        "trained driver.",
    )
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help=".mp4, .gif or .html; default: %(default)s")
    parser.add_argument("--env", help=f"environment id; default: that of the run, or {ENV_ID}")
    parser.add_argument(
        "--env-kwargs",
        nargs="+",
        default=[],
        type=hyperparameter,
        metavar="NAME:VALUE",
        help="keyword arguments of the environment, in YAML, such as scenario:curves",
    )
    parser.add_argument("--weather", help="weather of the episode; default: as in training")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episode")
    parser.add_argument("--steps", type=int, help="largest number of steps; default: the whole episode")
    parser.add_argument("--fps", type=float, help="frames per second; default: real time, or 10 if it is unknown")
    parser.add_argument("--width", type=int, default=640, help="width of the film [px]; default: %(default)s")
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="default: the one that saved the model")
    parser.add_argument(
        "--config",
        help="configuration with the environment, if the settings of the run are unknown; default: have",
    )
    parser.add_argument(
        "--vecnormalize", type=Path, metavar="FILE", help="file of VecNormalize.save(); default: vecnormalize.pkl"
    )
    parser.add_argument("--stochastic", action="store_true", help="sample the actions")
    parser.add_argument("--device", default="auto")
    args = parser.parse_args(arguments)
    if args.out.suffix.lower() not in (".mp4", ".gif", ".html"):
        parser.error(f"--out {args.out}: expected a name that ends in .mp4, .gif or .html")
    try:
        recording = watch(args)
    except KeyboardInterrupt:
        print("\nInterrupted, nothing was written.", file=sys.stderr)
        sys.exit(130)
    except (OSError, KeyError, ValueError, TypeError, GymnasiumError) as error:
        parser.error(str(error.args[0] if isinstance(error, KeyError) else error))
    distance = recording.end.get("distance")
    driven = "" if distance is None else f", {distance:.0f} m"
    print(f"{args.out}: {len(recording.infos)} steps, return {recording.rewards.sum():.1f}{driven}")


def watch(args: argparse.Namespace) -> Recording:
    """
    Drive the episode and write the film.

    :param args: Arguments of :func:`main`
    """
    args.out.parent.mkdir(parents=True, exist_ok=True)
    model: Predictor
    config: Mapping[str, Any] = {}
    statistics = args.vecnormalize
    # A folder without a model must not hide a trained driver. "./have" and "have/" are not names of drivers
    file = None
    try:
        file = model_file(args.model)
    except FileNotFoundError:
        if args.model not in driver_names():
            raise
    if file is None:
        if args.algo or args.config:
            raise ValueError(f"{args.model} is a trained driver, which needs neither --algo nor --config")
        model = pretrained(args.model, args.device)
        env_id, env_kwargs = args.env or model.card["env_id"], model.env_kwargs
    else:
        model, settings = load_model(file, args.algo, args.device)
        env_id, env_kwargs, config = environment(model, settings, args.env, args.config or "have")
        statistics = statistics or statistics_file(file, env_id)
    env_kwargs |= dict(args.env_kwargs) | ({} if args.weather is None else {"weather": args.weather})
    normalizer = None if statistics is None else saved_normalizer(statistics)
    print(
        f"{file or f'trained driver {args.model}'} in {env_id} {env_kwargs}"
        + ("" if normalizer is None else f", observations normalized as in {statistics}")
    )
    recording = record_episode(
        model,
        env_id,
        seed=args.seed,
        env_kwargs=env_kwargs,
        max_steps=args.steps,
        env_wrapper=env_wrapper(config),
        deterministic=not args.stochastic,
        render=env_id not in CAMERAS,  # cameras already show what the sensors see
        progress_bar=True,
        normalizer=normalizer,
    )
    if args.out.suffix.lower() == ".html":
        write_page(recording, args.out, ACTIONS if env_id in CAMERAS else ())
    else:
        write_animation(recording, args.out, args.fps, args.width, progress_bar=True)
    return recording


if __name__ == "__main__":
    main()
