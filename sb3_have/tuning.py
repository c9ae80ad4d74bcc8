"""The hyper-parameters of HAVESAC that a search with the RL Zoo samples, see :mod:`sb3_have.zoo`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna

# The Zoo's names
NET_ARCH = {"small": [64, 64], "medium": [256, 256], "big": [400, 300]}
# Exponents of two
BATCH_SIZE = (5, 8)


def sample_havesac_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Mapping[str, Any]
) -> dict[str, Any]:
    """
    Sample HAVESAC's hyper-parameters.

    ``gradient_steps`` stays as configured: ``train_freq`` alone decides how many steps there are per update. Parameters
    that define a method are not sampled: the re-fusion and ``local_coef`` if its critic has none, or if
    ``target="paper"`` fixes them.

    :param trial: Optuna trial object
    :param n_actions: Not used, nor is ``n_envs``
    :param additional_args: The configured hyper-parameters under "hyperparams", by default HAVESAC's own
    :return: Arguments of HAVESAC, with ``policy_kwargs``
    """
    config = additional_args.get("hyperparams", {})
    policy_kwargs = config.get("policy_kwargs") or {}
    value_estimation = {**policy_kwargs, **config}.get("value_estimation", "have")
    is_paper = config.get("target") == "paper"
    # The learning rate matters most, and 3e-4 is far too small for budgets of about 10,000 updates
    sampled: dict[str, Any] = {
        "learning_rate": trial.suggest_float("learning_rate", 2e-4, 3e-3, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.005, 0.1, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.05, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", *BATCH_SIZE),
        "train_freq": trial.suggest_categorical("train_freq", [1, 2, 4]),
        "policy_delay": trial.suggest_categorical("policy_delay", [1, 2, 4]),
        "modality_dropout": trial.suggest_float("modality_dropout", 0.0, 0.4),
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCH)),
        "features_dim": trial.suggest_categorical("features_dim", [32, 50, 100]),
    }
    if value_estimation != "gve" and not is_paper:
        sampled["local_coef"] = trial.suggest_float("local_coef", 0.1, 4.0, log=True)
    if value_estimation == "have" and not is_paper and "refusion" not in policy_kwargs:
        # Leave out "free": its output may decrease when a critic's value increases
        sampled["refusion"] = trial.suggest_categorical("refusion", ["convex", "monotone"])
    converted = convert_havesac_params(sampled)
    for name in ("gamma", "batch_size"):
        trial.set_user_attr(name, converted[name])
    return converted


def convert_havesac_params(sampled: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the parameters of a trial, as a study stores them, to arguments of HAVESAC."""
    hyperparams = dict(sampled)
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    hyperparams["batch_size"] = 2 ** hyperparams.pop("batch_size_pow")
    hyperparams["policy_kwargs"] = {
        "net_arch": list(NET_ARCH[hyperparams.pop("net_arch")]),
        "features_dim": hyperparams.pop("features_dim"),
    }
    return hyperparams
