"""What the Zoo would not understand in a configuration, or lose, said in options of its own."""

from __future__ import annotations

import argparse
import io
import re
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

from sb3_have.common.buffers import ModalityReplayBuffer
from sb3_have.configuration import model_kwargs, read_blocks

DOTTED_PATH = re.compile(r"[A-Za-z_]\w*(\.\w+)+")


def imported(module: str) -> Any:
    """A module of rl_zoo3.

    :raises ImportError: if it cannot be imported; says how to install it
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'{module} cannot be imported ({error}): pip install "sb3_have[zoo]"') from error


def stored(option: str, words: Sequence[str]) -> dict[str, Any]:
    """The ``name:value`` of an option as the Zoo reads them, by name.

    :raises ValueError: if a word is something else
    """
    found: dict[str, Any] = {}
    for word in words:
        namespace = argparse.Namespace()
        try:
            imported("rl_zoo3.utils").StoreDict([], "stored")(None, namespace, [word])
        except Exception as error:  # whatever Python makes of the value
            raise ValueError(
                f"{option} {word}: expected NAME:VALUE with a value in Python, such as gamma:0.98 or "
                f"\"ent_coef:'auto_0.1'\" ({type(error).__name__}: {error})"
            ) from error
        found |= namespace.stored
    return found


def read_hyperparams(options: argparse.Namespace) -> dict[str, Any]:
    """
    The configuration with what the command line says in its place.

    :param options: the user's, with ``algo``, ``env`` and ``folder`` completed
    :raises ValueError: if they cannot be read, or have no block for the environment
    """
    if str(options.conf_file).endswith((".yml", ".yaml")):
        read_blocks(options.conf_file)  # explains what is wrong with it
    manager = _manager(
        options,
        hyperparams=stored("-params", options.hyperparams),
        env_kwargs=stored("--env-kwargs", options.env_kwargs),
        config=options.conf_file,
    )
    with redirect_stdout(io.StringIO()):
        return dict(manager.read_hyperparameters()[0])


def read_trial(options: argparse.Namespace) -> dict[str, Any]:
    """
    What a trial had drawn.

    :param options: as above, with ``storage`` and ``study_name``
    :raises ValueError: if there is no such trial
    """
    storage, study, number = options.storage, options.study_name, options.trial_id
    if storage.endswith(".log") and not Path(storage).is_file():  # optuna would make an empty one
        raise ValueError(f"--trial-id {number}: there is no {storage}; `tune` writes it, --storage names another one")
    try:
        return dict(_manager(options).load_trial(storage, study, number))
    except (IndexError, KeyError) as error:
        raise ValueError(f"--trial-id {number}: {storage} has no such trial of a study {study!r}") from error


def _manager(options: argparse.Namespace, **kwargs: Any) -> Any:
    manager = imported("rl_zoo3.exp_manager").ExperimentManager
    return manager(options, options.algo, options.env, options.folder, **kwargs)


def hyperparams_option(options: argparse.Namespace, hyperparams: Mapping[str, Any], is_search: bool) -> list[str]:
    """
    ``--hyperparams`` again, if it has to say more than the user's.

    :param options: as above, with ``storage`` and ``study_name``
    :param hyperparams: of :func:`read_hyperparams`
    :param is_search: whether values are drawn, with whose ``policy_kwargs`` the configured ones are merged elsewhere
    :raises ValueError: if a class cannot be found, or the trial
    """
    values = in_python(hyperparams)
    # As sb3_have.train does: less memory than SB3's buffer takes for stacked images
    n_stack, has_buffer = hyperparams.get("frame_stack") or 1, "replay_buffer_class" in hyperparams
    if options.algo in ("tqc", "crossq") and n_stack > 1 and not has_buffer and hyperparams.get("n_steps", 1) == 1:
        values["replay_buffer_class"] = repr(expression(ModalityReplayBuffer))
        values["replay_buffer_kwargs"] = repr({"n_stack": n_stack, **hyperparams.get("replay_buffer_kwargs", {})})
    if is_search:
        values.pop("policy_kwargs", None)
    if options.trial_id is not None:  # the Zoo itself takes 0 for none
        given = stored("-params", options.hyperparams)
        values |= {key: expression(value) for key, value in read_trial(options).items() if key not in given}
    return _again("--hyperparams", options.hyperparams, values)


def eval_env_kwargs_option(options: argparse.Namespace, hyperparams: Mapping[str, Any]) -> list[str]:
    """``--eval-env-kwargs`` again, over the ``env_kwargs`` of the training, which the Zoo forgets there."""
    given = stored("--eval-env-kwargs", options.eval_env_kwargs)
    configured = hyperparams.get("env_kwargs") or stored("--env-kwargs", options.env_kwargs)
    missing = {key: expression(value) for key, value in configured.items() if key not in given}
    return _again("--eval-env-kwargs", options.eval_env_kwargs, missing)


def _again(option: str, given: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """The option with the user's words and others; the Zoo heeds the last one only."""
    return [option, *given, *(f"{key}:{value}" for key, value in values.items())] if values else []


def in_python(hyperparams: Mapping[str, Any]) -> dict[str, str]:
    """Those values that hold dotted paths of classes, as Python: where the Zoo evaluates a string, as Python in one."""
    left_to_the_zoo = {"policy", "env_wrapper", "vec_env_wrapper", "callback", "env_kwargs"}
    given = {key: value for key, value in hyperparams.items() if key not in left_to_the_zoo and not _is_python(value)}
    resolved = {key: value for key, value in model_kwargs(given).items() if value != given[key]}
    evaluated = {"policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"}
    expressions = {key: expression(value) for key, value in resolved.items()}
    return {key: repr(text) if key in evaluated else text for key, text in expressions.items()}


def _is_python(value: Any) -> bool:
    """Whether it is a string that only the Zoo can read."""
    return isinstance(value, str) and not DOTTED_PATH.fullmatch(value)


def expression(value: Any) -> str:
    """Python for a value of a configuration, which needs no import before it."""
    if isinstance(value, type):
        return f"__import__({value.__module__!r}, fromlist=[{value.__qualname__!r}]).{value.__qualname__}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key!r}: {expression(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(expression, value)) + "]"
    return repr(value)


def policy_kwargs(hyperparams: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a configuration, with classes for their dotted paths."""
    given = hyperparams.get("policy_kwargs") or {}
    if isinstance(given, str):  # in the names that the Zoo has there
        given = eval(given, vars(imported("rl_zoo3.exp_manager")).copy())
    return dict(model_kwargs({"policy_kwargs": given})["policy_kwargs"])
