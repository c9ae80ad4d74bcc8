"""The RL Zoo with HAVESAC in it: train, watch, search for hyper-parameters.

    python -m sb3_have.zoo train --algo havesac --env HighwayVision-v0 -P
    python -m sb3_have.zoo enjoy --algo havesac --env HighwayVision-v0
    python -m sb3_have.zoo tune --algo havesac --env ReliabilityDrive-v0 --max-total-trials 100

These are rl_zoo3's own commands with all of their options (``-h`` lists them), for its algorithms too. The differences:

- A configuration comes from ``zoo_configs`` where there is one for the algorithm; ``-conf`` also takes a bare name.
- ``--method lve`` is short for ``-conf lve``, its algorithm, and ``logs/lve`` for the log folder, in all commands.
- Classes may be given by their dotted path, see :func:`sb3_have.configuration.model_kwargs`; Python in strings, as the
  Zoo has it, is left to the Zoo.
- ``env_kwargs`` of a configuration are the evaluation's too, under ``--eval-env-kwargs``; the Zoo forgets them there.
- ``tune`` is ``train -optimize`` with a journal file ``optuna.log`` in the log folder for a storage, and one study for
  each configuration and environment, in which any number of processes work at once. ``train --trial-id`` looks there.
- ``policy_kwargs`` that a search draws are merged with those of the configuration; the Zoo would drop the latter.
- ``enjoy`` looks where ``train`` saves, shows the newest training that has a model (the Zoo takes the newest folder, be
  it that of a search), and does not ask an environment for pictures that has none to show.
- What is wrong in the command line or the configuration is told in one line, with exit status 2.

Another launcher gets the algorithms by :func:`register`.
"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from sb3_have import HAVESAC
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import config_names, config_path, read_blocks
from sb3_have.train import algorithm_of
from sb3_have.tuning import convert_havesac_params, merged, sample_havesac_params
from sb3_have.zoo_options import (
    eval_env_kwargs_option,
    hyperparams_option,
    imported,
    policy_kwargs,
    read_hyperparams,
    stored,
)

COMMANDS = {"train": "rl_zoo3.train", "tune": "rl_zoo3.train", "enjoy": "rl_zoo3.enjoy"}
INSTEAD = {
    "plots": "the Zoo's plots need pandas 2; learning curves of runs with several seeds, and their intervals, are made "
    "by python -m sb3_have.benchmark report",
    "push_to_hub": "the Zoo's does not work with the current huggingface_hub; upload the files by `hf upload`",
}
INSTEAD |= dict.fromkeys(("plot_train", "plot_from_file", "all_plots"), INSTEAD["plots"])
ENV_ID = "HighwayVision-v0"
OWN = ("havesac", "tqc", "crossq")
"""Algorithms with a configuration here. Not "sac": that name is SB3's in the Zoo, and ours is a method of HAVESAC."""
SEARCH = ("--n-evaluations", "3", "--eval-episodes", "10")
"""Of a trial: with the Zoo's one evaluation of 5 episodes nothing is pruned, and noise decides."""


def register(algo: str = "havesac", config: Mapping[str, Any] | None = None) -> None:
    """Put HAVESAC, and CrossQ for Dict observations, into the dictionaries of algorithms and searches of rl_zoo3.

    :param algo: whose search is to keep ``policy_kwargs``
    :param config: hyper-parameters with these ``policy_kwargs``
    """
    search = imported("rl_zoo3.hyperparams_opt")
    imported("rl_zoo3").ALGOS.update(havesac=HAVESAC, crossq=MultiInputCrossQ)
    sampler = partial(sample_havesac_params, config=config if algo == "havesac" else None)
    search.HYPERPARAMS_SAMPLER["havesac"] = sampler
    search.HYPERPARAMS_CONVERTER["havesac"] = convert_havesac_params
    if config and config.get("policy_kwargs"):
        for functions in (search.HYPERPARAMS_SAMPLER, search.HYPERPARAMS_CONVERTER):
            if algo in functions:
                plain = getattr(functions[algo], "__wrapped__", functions[algo])
                functions[algo] = merged(plain, config["policy_kwargs"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of ``python -m sb3_have.zoo``."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(__doc__)
        return
    command, *words = given
    try:
        if command not in COMMANDS:
            there_are = f"there is no such command; there are {', '.join(COMMANDS)}"
            raise ValueError(INSTEAD.get(command, there_are))
        program = imported(COMMANDS[command])
        words = zoo_arguments(command, words)
    except (ImportError, OSError, ValueError) as error:
        print(f"python -m sb3_have.zoo {command}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    before, sys.argv = sys.argv, [f"sb3_have.zoo {command}", *words]
    try:
        (program.enjoy if command == "enjoy" else program.train)()
    finally:
        sys.argv = before


def zoo_arguments(command: str, given: Sequence[str]) -> list[str]:
    """
    What the Zoo's command gets for what the user gave; HAVESAC is registered on the way.

    The Zoo heeds the last of an option that comes twice. So defaults stand before the user's words, and what completes
    or replaces these behind them.

    :param command: "train", "tune" or "enjoy"
    :param given: the Zoo's options, and ``--method``
    :raises ValueError: if an option makes no sense, or names what does not exist
    """
    register()
    own_parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    own_parser.add_argument("--method")
    own, words = own_parser.parse_known_args(given)
    if {"-h", "--help"} & set(words):
        print(f"--method NAME: of zoo_configs ({', '.join(config_names())}); python -m sb3_have.zoo -h says more\n")
        return words
    options = _parser(command).parse_known_args(words)[0]
    _import(options.gym_packages)
    options.env = options.env or ENV_ID
    if options.env not in gym.registry:
        raise ValueError(
            f"there is no environment {options.env!r}{_guess(options.env, gym.registry)}; --gym-packages imports "
            "packages that register others"
        )
    options.conf_file = _configuration(own.method, options.conf_file)
    options.algo = _algorithm(own.method, options.algo, options.conf_file)
    options.folder = options.folder or (f"logs/{own.method}" if own.method else "logs")
    defaults = ["--algo", options.algo, "--env", options.env]
    if command == "enjoy":
        return [*defaults, "--folder", options.folder, *words, *_enjoy_options(options)]

    options.conf_file = options.conf_file or _default_configuration(options.algo, options.env)
    name = Path(options.conf_file).stem if options.conf_file else options.algo
    options.storage = options.storage or f"{options.folder}/optuna.log"
    options.study_name = options.study_name or f"{name}-{options.env}"
    defaults += ["--log-folder", options.folder]
    if command == "tune" or options.trial_id is not None:
        defaults += ["--storage", options.storage, "--study-name", options.study_name]
    if command == "tune":
        defaults += ["--optimize-hyperparameters", *SEARCH]
    elif options.env == "CarlaVision-v0" and not options.eval_env_kwargs:
        defaults += ["--eval-freq", "-1"]  # the evaluation would need a second server
    return [*defaults, *words, *_training_options(command, options)]


def _parser(command: str) -> argparse.ArgumentParser:
    """Those of the Zoo's options that are looked at here."""
    parser = argparse.ArgumentParser(prog=f"python -m sb3_have.zoo {command}", add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-f", "--folder" if command == "enjoy" else "--log-folder", dest="folder")
    parser.add_argument("--env-kwargs", nargs="+", default=[])
    if command == "enjoy":
        parser.set_defaults(conf_file=None)
        parser.add_argument("--no-render", action="store_true")
        parser.add_argument("--exp-id", type=int, default=0)
        parser.add_argument("--load-best", action="store_true")
        parser.add_argument("--load-checkpoint", type=int)
        parser.add_argument("--load-last-checkpoint", action="store_true")
        return parser
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("--eval-env-kwargs", nargs="+", default=[])
    parser.add_argument("--trial-id", type=int)
    parser.add_argument("--storage")
    parser.add_argument("--study-name")
    return parser


def _import(packages: Iterable[str]) -> None:
    for package in packages:
        try:
            import_module(package)
        except ImportError as error:
            raise ValueError(f"--gym-packages {package} cannot be imported ({error}); is it installed?") from error


def _configuration(method: str | None, conf_file: str | None) -> str | None:
    """What ``--method`` or ``-conf`` ask for: a file, or a package as the Zoo takes it."""
    if method and conf_file:
        raise ValueError("--method is short for -conf; give one of them")
    name = method or conf_file
    if name is None:
        return None
    if name in config_names():
        return str(config_path(name))
    if not method and (Path(name).is_file() if name.endswith((".yml", ".yaml", ".py")) else _is_module(name)):
        return name
    raise ValueError(
        f"there is no {'method' if method else 'configuration'} {name!r}{_guess(name, config_names())}; there are "
        f"{', '.join(config_names())}"
    )


def _default_configuration(algo: str, env_id: str) -> str | None:
    """Of an algorithm; None where the Zoo has its own."""
    if algo not in OWN:
        return None
    path = config_path(algo)
    env_ids = read_blocks(path)
    if env_id in env_ids:
        return str(path)
    if algo == "havesac":
        raise ValueError(
            f"{path} has no block for {env_id!r}, only for {', '.join(env_ids)}; copy one into a file of your own, "
            "under that name, and give it by -conf"
        )
    return None


def _algorithm(method: str | None, algo: str | None, conf: str | None) -> str:
    """The given one, or that of the configuration."""
    algos = imported("rl_zoo3").ALGOS
    suited = algorithm_of(conf if conf and conf.endswith((".yml", ".yaml")) else "havesac")
    if algo is None:
        return suited
    if algo in config_names() and algo not in algos:
        raise ValueError(f"there is no algorithm {algo!r}; it is a method of HAVESAC: --method {algo}")
    if algo not in algos:
        raise ValueError(f"there is no algorithm {algo!r}{_guess(algo, algos)}; there are {', '.join(algos)}")
    if method and algo != suited:
        raise ValueError(f"--method {method} is of {suited}, not of {algo}: leave out --algo")
    return algo


def _training_options(command: str, options: argparse.Namespace) -> list[str]:
    """What ``train`` and ``tune`` get behind the user's words."""
    hyperparams = read_hyperparams(options)
    is_search = command == "tune" or options.trial_id is not None
    if is_search:
        register(options.algo, {**hyperparams, "policy_kwargs": policy_kwargs(hyperparams)})
        if options.algo not in imported("rl_zoo3.hyperparams_opt").HYPERPARAMS_SAMPLER:
            raise ValueError(f"the Zoo has no search for {options.algo!r}")
    return [
        *(["--conf-file", options.conf_file] if options.conf_file else []),
        *hyperparams_option(options, hyperparams, is_search),
        *eval_env_kwargs_option(options, hyperparams),
    ]


def _enjoy_options(options: argparse.Namespace) -> list[str]:
    """What ``enjoy`` gets behind the user's words. The newest folder may be a search's, which has no model."""
    stored("--env-kwargs", options.env_kwargs)  # explains a mistake in them
    entry_point = gym.spec(options.env).entry_point
    creator: Any = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    has_pictures = getattr(creator, "metadata", {}).get("render_modes") != []
    words = [] if has_pictures or options.no_render else ["--no-render"]
    if "rl-trained-agents" in options.folder:  # the Zoo downloads what is missing there
        return words
    utils, name = imported("rl_zoo3.utils"), imported("huggingface_sb3").EnvironmentName(options.env)
    newest = utils.get_latest_run_id(f"{options.folder}/{options.algo}", name)
    which = (options.load_best, options.load_checkpoint, options.load_last_checkpoint)
    missing = []
    for exp_id in [options.exp_id] if options.exp_id else [*range(newest, 0, -1), -1]:
        try:
            utils.get_model_path(exp_id, options.folder, options.algo, name, *which)
            return [*words, "--exp-id", str(exp_id)]
        except (AssertionError, ValueError) as error:
            missing.append(str(error))
    raise ValueError(f"{missing[0]}; `train` with the same options saves one, -f and --exp-id name others")


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _guess(name: str, known: Iterable[str]) -> str:
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.75)
    return "".join(f"; did you mean {match!r}?" for match in matches)


if __name__ == "__main__":
    keep_freed_memory()
    main()
