"""
Train by a configuration of ``zoo_configs``: a run that can be stopped and resumed at any moment.

    python -m sb3_have.train --config have --env HighwayVision-v0 --steps 200000 --seed 0 --out runs/have-0

The same command resumes. The folder holds ``monitor.csv`` (training episodes), ``evaluation.csv`` (a row per weather
at every evaluation), ``log-<first step>/progress.csv`` (SB3's log), the newest two ``checkpoint-<step>`` and
``model.zip``. A resumed run continues in the middle of its episodes; on a CPU the result equals that of an
uninterrupted run bit for bit (:mod:`sb3_have.checkpoint.checkpoint`).
"""

from __future__ import annotations

import argparse
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_have.algorithms import ALGORITHMS
from sb3_have.checkpoint import (
    ResumableCheckpointCallback,
    ResumableEnv,
    StopTrainingOnSignal,
    checkpoint_info,
    checkpoint_step,
    checkpoints,
    load_checkpoint,
    newest_checkpoint,
)
from sb3_have.checkpoint.files import locked, write_atomically
from sb3_have.checkpoint.stopping import delay_signals
from sb3_have.common.buffers import ModalityReplayBuffer, stacked_frames
from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import (
    algorithm_of,
    check_keys,
    env_wrapper,
    evaluation_env_kwargs,
    hyperparameter,
    load_config,
    make_callbacks,
    model_kwargs,
    monitor_kwargs,
    normalize_kwargs,
    wrap_vec_env,
)
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation.callback import WeatherEvalCallback
from sb3_have.evaluation.episodes import close, leave_interrupts_to_parent

VEC_ENVS: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}
"""By the Zoo's names."""


def make_training_env(env_id: str, config: Mapping[str, Any], out: Path | None = None) -> VecEnv:
    """
    Make the environments of a configuration, wrapped as in the Zoo, but with VecNormalize outside of VecFrameStack.

    :param env_id: Environment id
    :param config: Hyper-parameters; several environments (``n_envs``) run in processes of their own
    :param out: Folder in whose ``monitor.csv`` (``<i>.monitor.csv`` for several environments) episodes are appended
    """
    n_envs, wrapper, monitored = config.get("n_envs", 1), env_wrapper(config), monitor_kwargs(config)

    def make(index: int) -> gym.Env[Any, Any]:
        leave_interrupts_to_parent()
        env = gym.make(env_id, **config.get("env_kwargs", {}))
        env = env if wrapper is None else wrapper(env)

        # Record what the environments of this package know about an episode
        info = env.reset()[1]
        keywords = [key for key in ("distance", "weather", "end_reason") if key in info]
        kwargs = {**monitored, "info_keywords": (*keywords, *monitored.get("info_keywords", ()))}
        if out is None:
            return ResumableEnv(Monitor(env, **kwargs))
        file = out / (f"{index}.monitor.csv" if n_envs > 1 else "monitor.csv")
        return ResumableEnv(Monitor(env, str(file), override_existing=not file.exists(), **kwargs))

    makers: list[Callable[[], gym.Env[Any, Any]]] = [partial(make, index) for index in range(n_envs)]
    vec_env = wrap_vec_env(config, SubprocVecEnv(makers) if n_envs > 1 else DummyVecEnv(makers))
    n_stack = config.get("frame_stack") or 1
    if n_stack > 1:
        vec_env = VecFrameStack(vec_env, n_stack)
    # SB3 stores observations as they were before VecNormalize, so it has to be the outermost wrapper
    normalize = normalize_kwargs(config)
    return vec_env if normalize is None else VecNormalize(vec_env, **normalize)


class Run:
    """
    One training run in a folder, which resumes where it was stopped or killed.

    :param config: hyper-parameters, see :func:`load_config`
    :param env_id: Id of the environment
    :param out: Folder of the run; an earlier run in it is resumed, and must have had the same settings
    :param seed: Seed of everything random
    :param algo: Name in :data:`sb3_have.algorithms.ALGORITHMS`
    :param eval_freq: Steps from one evaluation to the next, 0 for none
    :param eval_episodes: Episodes in each weather of an evaluation
    :param eval_envs: Number of environments that an evaluation drives at a time, with one ``predict`` for all of them
    :param eval_env_kwargs: Keywords for the evaluation's environments, which override the configuration's
        ``env_kwargs``
    :param weathers: Weathers to evaluate in
    :param save_freq: Steps from one checkpoint to the next, 0 for only one at the end
    :param time_limit: Seconds of training in this session, None for no limit
    :param device: Device of the model
    :param eval_vec_env_cls: ``SubprocVecEnv`` steps each environment of an evaluation in a process of its own
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        env_id: str,
        out: Path,
        seed: int = 0,
        algo: str = "havesac",
        eval_freq: int = 10_000,
        eval_episodes: int = 2,
        eval_envs: int = 1,
        eval_env_kwargs: Mapping[str, Any] | None = None,
        weathers: Sequence[str] = WEATHERS,
        save_freq: int = 5_000,
        time_limit: float | None = None,
        device: str = "auto",
        eval_vec_env_cls: type[DummyVecEnv] | type[SubprocVecEnv] = DummyVecEnv,
    ) -> None:
        self.config, self.env_id, self.out, self.seed, self.algo = dict(config), env_id, Path(out), seed, algo
        self.save_freq, self.time_limit, self.device = save_freq, time_limit, device
        env_kwargs = {**config.get("env_kwargs", {}), **(eval_env_kwargs or {})}
        self._make_evaluation = partial(
            WeatherEvalCallback,
            env_id,
            weathers,
            self.out / "evaluation.csv",
            eval_freq=eval_freq,
            n_eval_episodes=eval_episodes,
            env_kwargs=evaluation_env_kwargs({"env_kwargs": env_kwargs}),
            env_wrapper=env_wrapper(self.config),
            n_envs=eval_envs,
            vec_env_cls=eval_vec_env_cls,
            verbose=1,
        )
        # Seconds of training and evaluation over all sessions, and whether a signal ended the last one
        self.seconds, self.interrupted = 0.0, False

    def train(self, steps: int, progress_bar: bool = False, keep_checkpoint: bool = True) -> OffPolicyAlgorithm:
        """
        Train up to a number of steps, from the newest checkpoint if there is one.

        :param steps: Training steps over all sessions
        :param progress_bar: Whether to show SB3's progress bar, and one for each evaluation
        :param keep_checkpoint: Whether to save checkpoints, with which the run can be resumed. Without them,
            ``model.zip`` is also saved if a second Ctrl-C interrupts the training
        :return: The model, which is also saved as ``model.zip``
        :raises BlockingIOError: If another process works in the folder
        :raises ValueError: If the folder is of another run, or of one that cannot be resumed
        """
        self._make_evaluation().check()
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out):
            checkpoint = self._checkpoint_to_resume()
            env = make_training_env(self.env_id, self.config, self.out)
            try:
                return self._train(checkpoint, env, steps, progress_bar, keep_checkpoint)
            finally:
                close(env)

    def _train(
        self, checkpoint: Path | None, env: VecEnv, steps: int, progress_bar: bool, keep_checkpoint: bool
    ) -> OffPolicyAlgorithm:
        stop = StopTrainingOnSignal(self.time_limit)
        callbacks: list[BaseCallback] = [
            stop,
            self._make_evaluation(seconds_before=self.seconds, progress_bar=progress_bar),
        ]
        saving = ResumableCheckpointCallback(self.out, self.save_freq, info=self._info)
        if keep_checkpoint:
            callbacks.insert(0, saving)
        callbacks += make_callbacks(self.config)

        if checkpoint is None:
            model = self._make_model(env)
        else:
            model = load_checkpoint(checkpoint, env, callbacks, self.device)
        logger = configure(str(self.out / f"log-{model.num_timesteps}"), ["csv"])
        model.set_logger(logger)
        self._started = time.monotonic()
        try:
            try:
                with stop:
                    model.learn(
                        max(0, steps - model.num_timesteps),
                        callbacks,
                        reset_num_timesteps=checkpoint is None,
                        progress_bar=progress_bar,
                    )
            finally:
                self.seconds += time.monotonic() - self._started
        except KeyboardInterrupt:
            # A second signal. Without checkpoints, only this keeps what was learned
            if not keep_checkpoint:
                self._save(model)
            raise
        else:
            self._save(model)
        finally:
            logger.close()
            saving.release()
        self.interrupted = stop.interrupted
        return model

    def _save(self, model: OffPolicyAlgorithm) -> None:
        """Save the model, even if a signal arrives in the meantime."""
        with delay_signals():
            write_atomically(self.out / "model.zip", model.save)
            if (normalizer := model.get_vec_normalize_env()) is not None:
                write_atomically(self.out / "vecnormalize.pkl", normalizer.save)  # type: ignore[arg-type]

    def _checkpoint_to_resume(self) -> Path | None:
        """Find the newest checkpoint of this run, and drop what was recorded after it: that is repeated."""
        checkpoint = newest_checkpoint(self.out)
        if checkpoint is not None:
            info, settings = checkpoint_info(checkpoint)["info"], self._settings()
            if info.get("settings") != settings:
                raise ValueError(
                    f"{checkpoint} belongs to a run with {info.get('settings')}, not {settings}; choose another folder"
                )
            self.seconds = info["seconds"]
            for path in self.out.glob("*monitor.csv"):
                self._drop_episodes(path, checkpoint_step(checkpoint))
            return checkpoint
        if damaged := checkpoints(self.out):
            raise ValueError(f"all checkpoints are damaged ({damaged[-1]} and before); remove them to start again")
        if (self.out / "model.zip").exists():
            raise ValueError(
                f"{self.out} has a model.zip but no checkpoint to resume from, and a new training would overwrite it; "
                "choose another folder, or remove this one (a benchmark keeps checkpoints with --keep-checkpoints)"
            )
        # Every run has this folder before it records anything
        log = self.out / "log-0"
        recorded = [*self.out.glob("*monitor.csv"), *self.out.glob("evaluation.csv")]
        if recorded and not log.exists():
            raise ValueError(f"{recorded[0]} was not written by this program; remove it, or choose another folder")
        log.mkdir(exist_ok=True)
        for path in recorded:
            path.unlink()
        return None

    def _drop_episodes(self, monitor: Path, step: int) -> None:
        head, *lines = monitor.read_text().splitlines(keepends=True)
        rows = pd.read_csv(io.StringIO("".join(lines)))
        kept = int((rows["l"].cumsum() <= step / self.config.get("n_envs", 1)).sum())
        write_atomically(monitor, partial(Path.write_text, data="".join([head, *lines[: kept + 1]])))

    def _make_model(self, env: VecEnv) -> OffPolicyAlgorithm:
        kwargs = model_kwargs(self.config, env)
        if self.algo != "havesac" and "replay_buffer_class" not in kwargs:  # as HAVESAC has by default
            derived = {"n_stack": stacked_frames(env), "n_steps": kwargs.pop("n_steps", 1)}
            derived |= {"gamma": kwargs.get("gamma", 0.99)}
            kwargs["replay_buffer_class"] = ModalityReplayBuffer
            kwargs["replay_buffer_kwargs"] = derived | kwargs.get("replay_buffer_kwargs", {})
        return ALGORITHMS[self.algo](env=env, seed=self.seed, device=self.device, **kwargs)

    def _settings(self) -> dict[str, Any]:
        config = {key: value for key, value in self.config.items() if key != "n_timesteps"}
        settings = {"config": config, "env_id": self.env_id, "seed": self.seed, "algo": self.algo}
        return dict(json.loads(json.dumps(settings)))

    def _info(self) -> dict[str, Any]:
        seconds = self.seconds + time.monotonic() - self._started
        return {"seconds": seconds, "settings": self._settings()}


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.train``."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_have.train", description=(__doc__ or "").strip().splitlines()[0]
    )
    parser.add_argument(
        "--config", default="have", help="YAML file, or the name of one in zoo_configs; default: %(default)s"
    )
    parser.add_argument("--algo", choices=list(ALGORITHMS), help="default: the one that the configuration names")
    parser.add_argument("--env", default="HighwayVision-v0", help="environment id")
    parser.add_argument(
        "--hyperparams",
        nargs="+",
        default=[],
        type=hyperparameter,
        metavar="NAME:VALUE",
        help='override hyper-parameters, as YAML: gamma:0.99 "policy_kwargs:{precision: float32}"',
    )
    parser.add_argument("--steps", type=int, help="total training steps; default: n_timesteps of the configuration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; the same folder resumes it")
    parser.add_argument("--eval-freq", type=int, default=10_000, help="steps between evaluations, 0 for none")
    parser.add_argument("--eval-episodes", type=int, default=2, help="in each weather")
    parser.add_argument(
        "--eval-envs",
        type=int,
        default=1,
        help="environments of an evaluation that are driven at a time; default: %(default)s",
    )
    parser.add_argument(
        "--eval-vec-env",
        choices=list(VEC_ENVS),
        default="dummy",
        help="all of them in this process, or each in one of its own; default: %(default)s",
    )
    parser.add_argument(
        "--eval-env-kwargs",
        nargs="+",
        default=[],
        type=hyperparameter,
        metavar="NAME:VALUE",
        help="for the evaluation's environments, over the configuration's env_kwargs; not the weather",
    )
    parser.add_argument("--save-freq", type=int, default=5_000, help="steps between checkpoints")
    parser.add_argument("--time-limit", type=float, help="seconds of training in this session")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--progress-bar", action="store_true")
    args = parser.parse_args(arguments)

    config = load_config(args.config, args.env) | dict(args.hyperparams)
    algo = args.algo or algorithm_of(args.config)
    check_keys(config, algo)
    run = Run(
        config,
        args.env,
        args.out,
        seed=args.seed,
        algo=algo,
        eval_freq=args.eval_freq,
        eval_episodes=args.eval_episodes,
        eval_envs=args.eval_envs,
        eval_env_kwargs=dict(args.eval_env_kwargs),
        save_freq=args.save_freq,
        time_limit=args.time_limit,
        device=args.device,
        eval_vec_env_cls=VEC_ENVS[args.eval_vec_env],
    )
    model = run.train(args.steps or int(config["n_timesteps"]), progress_bar=args.progress_bar)
    print(f"{model.num_timesteps} steps, {run.seconds / 60:.1f} min, {args.out / 'model.zip'}")


if __name__ == "__main__":
    keep_freed_memory()
    main()
