"""
The RL Zoo with HAVESAC in it: train, watch, and search for hyper-parameters.

    python -m sb3_have.zoo train -conf have --env HighwayVision-v0 -P
    python -m sb3_have.zoo enjoy --algo havesac --env HighwayVision-v0
    python -m sb3_have.zoo tune -conf have --env ReliabilityDrive-v0 --max-total-trials 100

These are rl_zoo3's own commands with all of their options (``-h`` lists them), for its algorithms too. The differences:

- The default configuration is that of ``zoo_configs``, if it has one for the algorithm. ``-conf`` accepts its names.
- ``--method lve`` is short for ``-conf lve`` with its algorithm and ``-f logs/lve``, in all commands.
- Files are read as :mod:`sb3_have.configuration` describes, so they may have a ``base`` and dotted paths of classes.
- The evaluation has the ``env_kwargs`` of the configuration, merged with ``--eval-env-kwargs``.
- ``tune`` is ``train -optimize`` with a journal ``optuna.log`` in the log folder, through which several processes may
  share a study. ``train --trial-id`` reads it.
- A search merges the ``policy_kwargs`` that it samples with those of the configuration.

:func:`register` gives another launcher all of this.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import VecEnv

from sb3_have.common.buffers import ModalityReplayBuffer
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import algorithm_of, config_names, config_path, load_config, model_kwargs, read_config
from sb3_have.have import HAVESAC
from sb3_have.tuning import convert_havesac_params, sample_havesac_params

try:
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
except ImportError as error:
    raise ImportError(f'the RL Zoo cannot be imported ({error}): pip install "sb3_have[zoo]"') from error


class HaveExperimentManager(ExperimentManager):
    """The Zoo's experiment manager for configurations of :mod:`sb3_have.configuration`."""

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        given = self.custom_hyperparams or {}
        if self.config.endswith((".yml", ".yaml")) and "base" in read_config(self.config):
            self.custom_hyperparams = {**load_config(self.config, self.env_name.gym_id), **given}
        trial_id, self.trial_id = self.trial_id, None
        hyperparams, saved = super().read_hyperparameters()

        # Resolve dotted paths of classes, which the Zoo knows for the policy alone
        left_to_the_zoo = ("policy", "learning_rate", "noise_type")
        hyperparams.update(model_kwargs({key: hyperparams[key] for key in hyperparams if key not in left_to_the_zoo}))

        # Load the trial; the Zoo would ignore trial 0 and the policy_kwargs of the configuration
        if trial_id is not None:
            trial = merged(hyperparams, self.load_trial(str(self.storage), str(self.study_name), trial_id))
            for values in (hyperparams, saved):
                values.update({key: value for key, value in trial.items() if key not in given})

        # Store each frame of stacked images once, as sb3_have.train does
        n_stack = hyperparams.get("frame_stack") or 1
        if self.algo in ("tqc", "crossq") and n_stack > 1 and not {"replay_buffer_class", "n_steps"} & set(hyperparams):
            hyperparams["replay_buffer_class"] = ModalityReplayBuffer
            configured = hyperparams.get("replay_buffer_kwargs", {})
            hyperparams["replay_buffer_kwargs"] = {"n_stack": n_stack, **configured}
        return hyperparams, saved

    def create_log_folder(self) -> None:
        # A search leaves no model that `enjoy` could show
        if not self.optimize_hyperparameters:
            super().create_log_folder()  # type: ignore[no-untyped-call]

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        if eval_env:
            self.eval_env_kwargs = {**self.env_kwargs, **self.eval_env_kwargs}
        return super().create_envs(n_envs, eval_env, no_log or self.optimize_hyperparameters)

    def hyperparameters_optimization(self) -> None:
        sample = HYPERPARAMS_SAMPLER[self.algo]

        def sample_merged(trial: Any, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
            sampled = sample(trial, n_actions, n_envs, {**additional_args, "hyperparams": self._hyperparams})
            return merged(self._hyperparams, sampled)

        HYPERPARAMS_SAMPLER[self.algo] = sample_merged
        try:
            super().hyperparameters_optimization()
        finally:
            HYPERPARAMS_SAMPLER[self.algo] = sample


def merged(hyperparams: Mapping[str, Any], sampled: Mapping[str, Any]) -> dict[str, Any]:
    """Return sampled hyper-parameters whose ``policy_kwargs`` are merged with the configured ones."""
    return {**sampled, "policy_kwargs": {**hyperparams.get("policy_kwargs", {}), **sampled.get("policy_kwargs", {})}}


def register() -> None:
    """Add HAVESAC, its search, CrossQ for Dict observations, and this module's experiment manager to rl_zoo3."""
    rl_zoo3.ALGOS.update(havesac=HAVESAC, crossq=MultiInputCrossQ)
    HYPERPARAMS_SAMPLER["havesac"] = sample_havesac_params
    HYPERPARAMS_CONVERTER["havesac"] = convert_havesac_params  # type: ignore[assignment]
    vars(rl_zoo3.train)["ExperimentManager"] = HaveExperimentManager


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.zoo``."""
    command, *given = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if command in ("-h", "--help"):
        print(__doc__)
        return
    if command not in ("train", "tune", "enjoy"):
        sys.exit(f"there is no command {command!r}; there are train, tune and enjoy")
    register()
    before, sys.argv = sys.argv, [f"sb3_have.zoo {command}", *zoo_arguments(command, given)]
    try:
        if command == "enjoy":
            import_module("rl_zoo3.enjoy").enjoy()
        else:
            rl_zoo3.train.train()
    finally:
        sys.argv = before


def zoo_arguments(command: str, given: Sequence[str]) -> list[str]:
    """
    Complete the arguments of one of the Zoo's commands.

    The Zoo takes the last of an option that occurs twice, so the defaults come before what the user gave.

    :param command: "train", "tune" or "enjoy"
    :param given: The Zoo's options, and ``--method``
    """
    parser = argparse.ArgumentParser(prog=f"python -m sb3_have.zoo {command}", add_help=False, allow_abbrev=False)
    parser.add_argument("--method", choices=config_names(), metavar="NAME")
    words = parser.parse_known_args(given)[1]
    parser.add_argument("--algo")
    parser.add_argument("--env", default="HighwayVision-v0")
    parser.add_argument("-f", "--folder", "--log-folder", dest="folder")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("--trial-id")
    parser.add_argument("-conf", "--conf-file")
    options = parser.parse_known_args(given)[0]
    for package in options.gym_packages:
        import_module(package)

    if options.method and options.conf_file:
        parser.error("--method is short for -conf; use one of them")
    # Find the configuration, its algorithm, and the log folder
    conf = options.method or options.conf_file
    if conf is None and options.algo in (None, "havesac"):
        conf = "have"
    elif conf is None and options.algo in config_names() and options.env in read_config(options.algo):
        conf = options.algo
    if conf in config_names() or (conf is not None and "." not in conf and find_spec(conf) is None):
        conf = str(config_path(conf))
    algo = algorithm_of(conf) if conf is not None and conf.endswith((".yml", ".yaml")) else "havesac"
    folder = options.folder or (f"logs/{options.method}" if options.method else "logs")
    defaults = ["--algo", algo, "--env", options.env, "-f", folder]
    if command == "enjoy":
        return [*defaults, *words, *([] if can_render(options.env) else ["--no-render"])]
    if command == "tune" or options.trial_id is not None:
        name = Path(conf).stem if conf is not None else options.algo
        defaults += ["--storage", f"{folder}/optuna.log", "--study-name", f"{name}-{options.env}"]
    if command == "tune":
        # With the Zoo's single evaluation of 5 episodes nothing is pruned, and noise decides
        defaults += ["--optimize-hyperparameters", "--n-evaluations", "3", "--eval-episodes", "10"]
    elif options.env == "CarlaVision-v0" and "--eval-env-kwargs" not in words:
        # An evaluation needs the port of a second server
        defaults += ["--eval-freq", "-1"]
    return [*defaults, *words, *([] if conf is None else ["--conf-file", conf])]


def can_render(env_id: str) -> bool:
    """Whether an environment has pictures to show."""
    entry_point = gym.spec(env_id).entry_point
    creator: Any = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return bool(getattr(creator, "metadata", {}).get("render_modes", True))


if __name__ == "__main__":
    keep_freed_memory()
    main()
