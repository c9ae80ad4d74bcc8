"""Train by a configuration of ``zoo_configs``: a run that can be stopped and resumed at any moment.

    python -m sb3_have.train --config have --env HighwayVision-v0 --steps 200000 --seed 0 --out runs/have-0

The same command resumes. The folder holds ``monitor.csv`` (training episodes), ``evaluation.csv`` (a row per weather
at every evaluation), ``log-<first step>/progress.csv`` (SB3's log), the newest two ``checkpoint-<step>`` and
``model.zip``. A resumed run goes on in the middle of its episodes; on a CPU it ends with the bits of an uninterrupted
one (:mod:`sb3_have.checkpoint.checkpoint`).
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_have.algorithms import ALGORITHMS
from sb3_have.checkpoint.checkpoint import (
    checkpoint_info,
    checkpoints,
    load_checkpoint,
    refuse_older_form,
    same_random_numbers,
    write_checkpoint,
)
from sb3_have.checkpoint.checkpoint import checkpoint_step as checkpoint_step
from sb3_have.checkpoint.checkpoint import newest_checkpoint as newest_checkpoint
from sb3_have.checkpoint.env_state import ResumableEnv
from sb3_have.checkpoint.files import locked, write_atomically
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
from sb3_have.evaluation.episodes import leave_interrupts_to_parent
from sb3_have.evaluation.evaluation import evaluate
from sb3_have.run_callback import RunCallback as RunCallback
from sb3_have.run_callback import TrainingStopped, is_due

EVALUATION_SEED = 1_000_000
"""Of the episodes that evaluate a run while it trains: the same for all runs."""

VEC_ENVS: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}
"""By the Zoo's names."""

KEPT_CHECKPOINTS = 2
"""Of which the older one is for the case that the newest is damaged."""


def make_training_env(env_id: str, config: Mapping[str, Any], out: Path | None = None) -> VecEnv:
    """Make the environments of a configuration, wrapped as the Zoo wraps them.

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
    normalize = normalize_kwargs(config)
    if normalize is not None:
        vec_env = VecNormalize(vec_env, **normalize)
    n_stack = config.get("frame_stack") or 1
    return VecFrameStack(vec_env, n_stack) if n_stack > 1 else vec_env


class Run:
    """One training run in a folder.

    :param config: hyper-parameters, see :func:`load_config`
    :param env_id: of the environment
    :param out: folder; what it holds of an earlier run with the same settings is resumed
    :param seed: of everything random; an earlier run in the folder must have had the same
    :param algo: name in :data:`sb3_have.algorithms.ALGORITHMS`
    :param eval_freq: steps from one evaluation to the next, 0 for none
    :param eval_episodes: episodes in each weather of an evaluation
    :param eval_envs: number of environments that an evaluation drives at a time, with one ``predict`` for all of them
    :param eval_env_kwargs: for the evaluation's environments, over the configuration's ``env_kwargs``
    :param weathers: to evaluate in
    :param save_freq: steps from one checkpoint to the next, 0 for one at the end only
    :param time_limit: of the training in this call [s], None for none
    :param device: of the model
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
        self.eval_freq, self.eval_episodes = eval_freq, eval_episodes
        self.eval_envs, self.eval_vec_env_cls = eval_envs, eval_vec_env_cls
        env_kwargs = {**config.get("env_kwargs", {}), **(eval_env_kwargs or {})}
        self.eval_env_kwargs = evaluation_env_kwargs({"env_kwargs": env_kwargs})
        self.weathers, self.save_freq, self.time_limit = weathers, save_freq, time_limit
        self.device = device
        self.seconds = 0.0  # spent training and evaluating, over all sessions
        self.interrupted = False
        self._rollout_started = self._in_mid_rollout = False
        self._saved_step = -1
        self._progress_bar = False

    def train(self, steps: int, progress_bar: bool = False, keep_checkpoint: bool = True) -> OffPolicyAlgorithm:
        """Train up to a number of steps, from the newest checkpoint if there is one.

        :param steps: in all, earlier sessions included
        :param progress_bar: SB3's, and one for each evaluation
        :param keep_checkpoint: whether to write the replay buffer at the end, so that the run can go on
        :return: the model; also saved as ``model.zip``
        :raises BlockingIOError: if another process works in the folder
        :raises ValueError: if the folder is of another run, or of one that cannot go on
        """
        self._progress_bar = progress_bar
        self.out.mkdir(parents=True, exist_ok=True)
        with locked(self.out):
            return self._train(steps, keep_checkpoint)

    def _train(self, steps: int, keep_checkpoint: bool) -> OffPolicyAlgorithm:
        refuse_older_form(self.out)
        checkpoint = newest_checkpoint(self.out)
        if checkpoint is None and (damaged := checkpoints(self.out)):
            raise ValueError(f"all checkpoints are damaged ({damaged[-1]} and before); remove them to begin anew")
        if checkpoint is None and (self.out / "model.zip").exists():
            raise ValueError(
                f"{self.out} has a model.zip but no checkpoint to go on from, and training would begin anew, over it; "
                "choose another folder, or remove this one (a benchmark keeps checkpoints with --keep-checkpoints)"
            )
        done = 0 if checkpoint is None else checkpoint_step(checkpoint)
        self._saved_step = done
        if checkpoint is not None:
            self._check_same_run(checkpoint)
        self._forget_after(done)
        env = make_training_env(self.env_id, self.config, self.out)
        try:
            model = self._make_model(checkpoint, env)
            self.evaluate_if_due(model)
            if done < steps:
                self._learn(model, steps - done)
            if self._in_mid_rollout:
                return model  # what is on disk is whole
            if keep_checkpoint and model.num_timesteps > done:
                self.save(model, self._rollout_started)
        finally:
            env.close()
        write_atomically(self.out / "model.zip", model.save)
        return model

    def _learn(self, model: OffPolicyAlgorithm, steps: int) -> None:
        done = model.num_timesteps
        self._rollout_started = self._in_mid_rollout = False
        callback, logger = RunCallback(self), configure(str(self.out / f"log-{done}"), ["csv"])
        model.set_logger(logger)
        try:
            callbacks = [callback, *make_callbacks(self.config)]
            model.learn(steps, callback=callbacks, reset_num_timesteps=done == 0, progress_bar=self._progress_bar)
        except TrainingStopped:
            self._rollout_started = True
        except KeyboardInterrupt:  # the second one: the first ends the training by itself
            self._in_mid_rollout = True
        finally:
            callback.restore_handlers()
            logger.close()
        self.interrupted = callback.stopping or self._in_mid_rollout

    def _check_same_run(self, checkpoint: Path) -> None:
        state = checkpoint_info(checkpoint)["info"]
        now = self._settings()
        if (settings := state.get("settings")) != now:
            raise ValueError(f"{checkpoint} is of a run with {settings}, not {now}; choose another folder")
        self.seconds = state["seconds"]

    def _make_model(self, checkpoint: Path | None, env: VecEnv) -> OffPolicyAlgorithm:
        if checkpoint is not None:
            resumed: OffPolicyAlgorithm = load_checkpoint(checkpoint, env, device=self.device)
            return resumed
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

    def _forget_after(self, step: int) -> None:
        """Drop what was recorded after the checkpoint that is resumed: it will be lived through again."""
        recorded = [*self.out.glob("*monitor.csv"), *self.out.glob("evaluation.csv")]
        if step == 0:
            log = self.out / "log-0"  # every run has it, before it records anything
            if recorded and not log.exists():
                raise ValueError(f"{recorded[0]} is of no run of this program; remove it, or choose another folder")
            log.mkdir(exist_ok=True)
            for path in recorded:
                path.unlink()
            return
        for path in recorded:
            if path.name == "evaluation.csv":
                rows = pd.read_csv(path)
                write_atomically(path, partial(rows[rows["step"] <= step].to_csv, index=False))
                continue
            head, *lines = path.read_text().splitlines(keepends=True)
            rows = pd.read_csv(io.StringIO("".join(lines)))
            kept = int((rows["l"].cumsum() <= step / self.config.get("n_envs", 1)).sum())
            write_atomically(path, partial(Path.write_text, data="".join([head, *lines[: kept + 1]])))

    def save(self, model: Any, rollout_started: bool = False) -> None:
        """Write ``checkpoint-<step>``, unless it exists already."""
        if model.num_timesteps != self._saved_step:  # a file of that name may be a damaged one
            info = {"seconds": self.seconds, "settings": self._settings()}
            if write_checkpoint(self.out, model, KEPT_CHECKPOINTS, info=info, rollout_started=rollout_started):
                self._saved_step = model.num_timesteps

    def evaluate_if_due(self, model: Any) -> None:
        """Evaluate, if there is no evaluation since the last multiple of ``eval_freq``; the training does not notice.

        :param model: between two rollouts
        """
        path = self.out / "evaluation.csv"
        last_step = int(max(pd.read_csv(path)["step"], default=0)) if path.exists() else 0
        if is_due(self.eval_freq, model.num_timesteps, last_step):
            with same_random_numbers():
                self.evaluate(model, model.num_timesteps)

    def evaluate(self, model: Any, step: int) -> None:
        """Append a row per weather to ``evaluation.csv`` and print their mean."""
        frame = evaluate(
            model,
            self.env_id,
            self.weathers,
            self.eval_episodes,
            EVALUATION_SEED,
            self.eval_env_kwargs,
            n_envs=self.eval_envs,
            env_wrapper=env_wrapper(self.config),
            progress_bar=self._progress_bar,
            vec_env_cls=self.eval_vec_env_cls,
        )
        frame.insert(0, "step", step)
        frame.insert(1, "seed", self.seed)
        frame.insert(2, "wall_time", round(self.seconds, 1))
        path = self.out / "evaluation.csv"
        before = path.read_text() if path.exists() else ""
        rows = frame.to_csv(header=not before, index=False, lineterminator="\n")
        write_atomically(path, partial(Path.write_text, data=before + rows))
        print(
            f"step {step}: return {frame['return_mean'].mean():.1f}, distance {frame['distance_mean'].mean():.0f} m "
            f"over {len(frame)} weathers, {self.seconds / 60:.1f} min",
            flush=True,
        )


def main(arguments: list[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.train``."""
    parser = argparse.ArgumentParser(prog="python -m sb3_have.train", description=(__doc__ or "").splitlines()[0])
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
        help='in the configuration\'s place, in YAML: gamma:0.99 "policy_kwargs:{precision: float32}"',
    )
    parser.add_argument("--steps", type=int, help="in all; default: n_timesteps of the configuration")
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
