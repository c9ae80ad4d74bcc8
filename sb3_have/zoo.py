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
- ``enjoy`` looks where ``train`` saves, and does not ask an environment for pictures that has none to show.

Another launcher gets the algorithms by :func:`register`.
"""

from __future__ import annotations

import argparse
import difflib
import io
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import yaml
from gymnasium.envs.registration import load_env_creator

from sb3_have import HAVESAC, ModalityReplayBuffer
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.memory import keep_freed_memory
from sb3_have.configuration import config_names, config_path, model_kwargs
from sb3_have.train import algorithm_of
from sb3_have.tuning import convert_havesac_params, merged, sample_havesac_params

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
DOTTED_PATH = re.compile(r"[A-Za-z_]\w*(\.\w+)+")
SEARCH = {"n_evaluations": "3", "eval_episodes": "10"}
"""Of a trial: with the Zoo's one evaluation of 5 episodes nothing is pruned, and noise decides."""


def register(algo: str = "havesac", config: Mapping[str, Any] | None = None) -> None:
    """Put HAVESAC, and CrossQ for Dict observations, into the dictionaries of algorithms and searches of rl_zoo3.

    :param algo: whose search is to keep ``policy_kwargs``
    :param config: hyper-parameters with these ``policy_kwargs``
    """
    search = _imported("rl_zoo3.hyperparams_opt")
    _imported("rl_zoo3").ALGOS.update(havesac=HAVESAC, crossq=MultiInputCrossQ)
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
    command, *options = given
    if command not in COMMANDS:
        _fail(command, INSTEAD.get(command, f"there is no such command; there are {', '.join(COMMANDS)}"))
    module = _imported(COMMANDS[command])
    before, sys.argv = sys.argv, [f"sb3_have.zoo {command}", *zoo_arguments(command, options)]
    try:
        getattr(module, COMMANDS[command].rpartition(".")[2])()
    finally:
        sys.argv = before


def zoo_arguments(command: str, given: Sequence[str]) -> list[str]:
    """What the Zoo's command gets for what the user gave; HAVESAC is registered on the way.

    :param command: "train", "tune" or "enjoy"
    :param given: the Zoo's options, and ``--method``
    """
    register()
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--method")
    known, rest = parser.parse_known_args(given)
    if {"-h", "--help"} & set(rest):
        print(f"--method NAME: of zoo_configs ({', '.join(config_names())}); python -m sb3_have.zoo -h says more\n")
        return rest
    return CommandLine(command, known.method, rest).completed()


class CommandLine:
    """What a user gave, to be completed for the Zoo.

    :param command: "train", "tune" or "enjoy"
    :param method: name of a configuration in ``zoo_configs``, or None
    :param rest: the Zoo's options
    """

    def __init__(self, command: str, method: str | None, rest: Sequence[str]) -> None:
        self.command, self.method, self.rest = command, method, list(rest)
        self.given = _parser(command).parse_known_args(self.rest)[0]
        self.env_id = self.given.env or ENV_ID
        for package in self.given.gym_packages:
            import_module(package)
        if self.env_id not in gym.registry:
            self.fail(f"there is no environment {self.env_id!r}{_guess(self.env_id, gym.registry)}")
        self.conf = self._conf()
        self.algo = self._algo()
        if self.conf is None and self.algo in OWN and command != "enjoy":
            self.conf = self._default_conf()
        self.folder = self.given.folder or (f"logs/{method}" if method else "logs")

    def fail(self, message: str) -> NoReturn:
        """End the program."""
        _fail(self.command, message)

    def completed(self) -> list[str]:
        """Options for the Zoo: the user's, and what they leave open."""
        completed = [*self.rest, *self._unless_given(algo=self.algo, env=self.env_id)]
        folder = "--folder" if self.command == "enjoy" else "--log-folder"
        completed += [] if self.given.folder else [folder, self.folder]
        if self.command == "enjoy":
            return [*completed, *(["--no-render"] if self._has_no_pictures() else [])]
        if self.conf is not None:
            completed += ["--conf-file", self.conf]
        if self.command == "tune":
            completed += ["--optimize-hyperparameters", *self._unless_given(**SEARCH)]
        if self.command == "tune" or self.given.trial_id is not None:
            completed += self._unless_given(storage=self.storage, study_name=self.study_name)
        elif self.env_id == "CarlaVision-v0" and not self.given.eval_env_kwargs:
            completed += self._unless_given(eval_freq="-1")  # the evaluation would need a second server
        return [*completed, *self._hyperparams()]

    @property
    def storage(self) -> str:
        """Of the search: that was given, or a journal file."""
        return str(self.given.storage or f"{self.folder}/optuna.log")

    @property
    def study_name(self) -> str:
        """Of the search: that was given, or one for configuration and environment."""
        return str(self.given.study_name or f"{Path(self.conf).stem if self.conf else self.algo}-{self.env_id}")

    def _unless_given(self, **options: str) -> list[str]:
        missing = {name: value for name, value in options.items() if getattr(self.given, name) is None}
        return [word for name, value in missing.items() for word in (f"--{name.replace('_', '-')}", value)]

    def _conf(self) -> str | None:
        """What ``--method`` or ``-conf`` ask for: a file, or a package as the Zoo takes it."""
        name = self.method or self.given.conf_file
        if name is None:
            return None
        if self.method is None:
            if self.given.conf_file and name.endswith((".yml", ".yaml", ".py")) and Path(name).is_file():
                return str(name)
            if name not in config_names() and _is_module(name):
                return str(name)
        elif self.given.conf_file:
            self.fail("--method is short for -conf; give one of them")
        if name not in config_names():
            kind = "method" if self.method else "configuration"
            self.fail(
                f"there is no {kind} {name!r}{_guess(name, config_names())}; there are {', '.join(config_names())}"
            )
        return str(config_path(name))

    def _algo(self) -> str:
        algos, algo, conf = _imported("rl_zoo3").ALGOS, self.given.algo, self.conf or ""
        suited = algorithm_of(conf if conf.endswith((".yml", ".yaml")) else "havesac")
        if algo is None:
            return suited
        if algo not in algos:
            is_method = algo in config_names()
            hint = f"; it is a method of HAVESAC: --method {algo}" if is_method else _guess(algo, algos)
            self.fail(f"there is no algorithm {algo!r}{hint}")
        if self.method and algo != suited:
            self.fail(f"--method {self.method} is of {suited}, not of {algo}: leave out --algo")
        return str(algo)

    def _default_conf(self) -> str | None:
        path = config_path(self.algo)
        env_ids = yaml.safe_load(path.read_text())
        if self.env_id in env_ids:
            return str(path)
        if self.algo == "havesac":
            self.fail(
                f"{path} has no block for {self.env_id!r}, only for {', '.join(env_ids)}; copy one into a file of your "
                "own, under that name, and give it by -conf"
            )
        return None  # the Zoo has its own

    def _has_no_pictures(self) -> bool:
        creator = gym.spec(self.env_id).entry_point
        metadata = getattr(load_env_creator(creator) if isinstance(creator, str) else creator, "metadata", {})
        return not self.given.no_render and metadata.get("render_modes") == []

    def _hyperparams(self) -> list[str]:
        """What the Zoo would not understand in the configuration, or lose, as options of its own."""
        manager, given = self._manager(), _stored(self.given.hyperparams)
        try:
            with redirect_stdout(io.StringIO()):
                hyperparams, _ = manager.read_hyperparameters()
            params = _in_python(hyperparams)
        except ValueError as error:
            self.fail(str(error))
        # As sb3_have.train does: less memory than SB3's buffer takes for stacked images
        n_stack, has_buffer = hyperparams.get("frame_stack") or 1, "replay_buffer_class" in hyperparams
        if self.algo in ("tqc", "crossq") and n_stack > 1 and not has_buffer and hyperparams.get("n_steps", 1) == 1:
            params["replay_buffer_class"] = repr(_expression(ModalityReplayBuffer))
            params["replay_buffer_kwargs"] = repr({"n_stack": n_stack, **hyperparams.get("replay_buffer_kwargs", {})})
        if self.command == "tune" or self.given.trial_id is not None:
            register(self.algo, {**hyperparams, "policy_kwargs": _policy_kwargs(hyperparams)})
            params.pop("policy_kwargs", None)  # as part of what is drawn
            if self.algo not in _imported("rl_zoo3.hyperparams_opt").HYPERPARAMS_SAMPLER:
                self.fail(f"the Zoo has no search for {self.algo!r}")
        if self.given.trial_id == 0:  # to the Zoo that is none
            trial = manager.load_trial(self.storage, self.study_name, 0)
            params |= {key: _expression(value) for key, value in trial.items() if key not in given}
        return [
            *_option("--hyperparams", self.given.hyperparams, params),
            *self._eval_env_kwargs(hyperparams),
        ]

    def _manager(self) -> Any:
        """The Zoo's reader of configurations."""
        manager = _imported("rl_zoo3.exp_manager").ExperimentManager
        return manager(
            self.given,
            self.algo,
            self.env_id,
            self.folder,
            hyperparams=_stored(self.given.hyperparams),
            env_kwargs=_stored(self.given.env_kwargs),
            config=self.conf,
        )

    def _eval_env_kwargs(self, hyperparams: Mapping[str, Any]) -> list[str]:
        given = _stored(self.given.eval_env_kwargs)
        configured = hyperparams.get("env_kwargs", _stored(self.given.env_kwargs))
        missing = {key: _expression(value) for key, value in configured.items() if key not in given}
        return _option("--eval-env-kwargs", self.given.eval_env_kwargs, missing)


def _parser(command: str) -> argparse.ArgumentParser:
    """Those of the Zoo's options that are looked at here."""
    parser = argparse.ArgumentParser(prog=f"python -m sb3_have.zoo {command}", add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--env")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    parser.add_argument("-f", "--folder" if command == "enjoy" else "--log-folder", dest="folder")
    parser.add_argument("--env-kwargs", nargs="+", default=[])
    parser.set_defaults(conf_file=None)
    if command == "enjoy":
        parser.add_argument("--no-render", action="store_true")
        return parser
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-params", "--hyperparams", nargs="+", default=[])
    parser.add_argument("--eval-env-kwargs", nargs="+", default=[])
    parser.add_argument("--trial-id", type=int)
    for option in ("--eval-freq", "--eval-episodes", "--n-evaluations", "--storage", "--study-name"):
        parser.add_argument(option)
    return parser


def _stored(words: Sequence[str]) -> dict[str, Any]:
    """Of ``name:value ...``, as the Zoo reads it."""
    namespace = argparse.Namespace()
    _imported("rl_zoo3.utils").StoreDict([], "stored")(None, namespace, words)
    return dict(namespace.stored)


def _option(name: str, given: Sequence[str], more: Mapping[str, str]) -> list[str]:
    """The option again, with more in it; the Zoo heeds the last one only."""
    return [name, *given, *(f"{key}:{value}" for key, value in more.items())] if more else []


def _in_python(hyperparams: Mapping[str, Any]) -> dict[str, str]:
    """Those values that hold dotted paths of classes, as Python: where the Zoo evaluates a string, as Python in one."""
    left_to_the_zoo = {"policy", "env_wrapper", "vec_env_wrapper", "callback", "env_kwargs"}
    given = {key: value for key, value in hyperparams.items() if key not in left_to_the_zoo and not _is_python(value)}
    resolved = {key: value for key, value in model_kwargs(given).items() if value != given[key]}
    evaluated = {"policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"}
    expressions = {key: _expression(value) for key, value in resolved.items()}
    return {key: repr(text) if key in evaluated else text for key, text in expressions.items()}


def _is_python(value: Any) -> bool:
    """Whether it is a string that only the Zoo can read."""
    return isinstance(value, str) and not DOTTED_PATH.fullmatch(value)


def _expression(value: Any) -> str:
    """Python for a value of a configuration, which needs no import before it."""
    if isinstance(value, type):
        return f"__import__({value.__module__!r}, fromlist=[{value.__qualname__!r}]).{value.__qualname__}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key!r}: {_expression(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_expression, value)) + "]"
    return repr(value)


def _policy_kwargs(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    given = hyperparams.get("policy_kwargs") or {}
    if isinstance(given, str):  # in the names that the Zoo has there
        given = eval(given, vars(_imported("rl_zoo3.exp_manager")).copy())
    return dict(model_kwargs({"policy_kwargs": given})["policy_kwargs"])


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _guess(name: str, known: Iterable[str]) -> str:
    return "".join(f"; did you mean {match!r}?" for match in difflib.get_close_matches(name, list(known), n=1))


def _imported(module: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'{module} cannot be imported ({error}): pip install "sb3_have[zoo]"') from error


def _fail(command: str, message: str) -> NoReturn:
    print(f"python -m sb3_have.zoo {command}: {message}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    keep_freed_memory()
    main()
