"""What a search by the RL Zoo tries for HAVESAC; :func:`sb3_have.zoo.register` hands it over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna

NET_ARCH = {"small": [64, 64], "medium": [256, 256], "big": [400, 300]}
"""As the Zoo calls them."""
BATCH_SIZE = (5, 8)
"""Powers of two."""


def sample_havesac_params(
    trial: optuna.Trial,
    n_actions: int,
    n_envs: int,
    additional_args: dict[str, Any],
    config: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Draw HAVESAC's hyper-parameters.

    ``gradient_steps`` is left as configured: ``train_freq`` alone sets how many steps there are to an update. What
    makes a method is not drawn: re-fusion and ``local_coef`` where a critic has none or ``target="paper"`` fixes them.

    :param trial: what draws
    :param n_actions: as the Zoo gives it, not used; likewise ``n_envs`` and ``additional_args``
    :param config: hyper-parameters as configured, ``policy_kwargs`` as a mapping; by default HAVESAC's own
    :return: arguments of HAVESAC, with ``policy_kwargs``
    """
    config = config or {}
    policy_kwargs = config.get("policy_kwargs") or {}
    values = {**policy_kwargs, **config}.get("value_estimation", "have")
    is_paper = config.get("target") == "paper"
    # The learning rate decides most, and 3e-4 is much too small for budgets of some 10,000 updates
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
    if values != "gve" and not is_paper:
        sampled["local_coef"] = trial.suggest_float("local_coef", 0.1, 4.0, log=True)
    if values == "have" and not is_paper and "refusion" not in policy_kwargs:
        # "free" is left out: its values may fall where a critic's rise
        sampled["refusion"] = trial.suggest_categorical("refusion", ["convex", "monotone"])
    converted = convert_havesac_params(sampled)
    for name in ("gamma", "batch_size"):
        trial.set_user_attr(name, converted[name])
    return converted


def convert_havesac_params(sampled: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of HAVESAC from a trial's parameters, as a study stores them."""
    hyperparams = dict(sampled)
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    hyperparams["batch_size"] = 2 ** hyperparams.pop("batch_size_pow")
    hyperparams["policy_kwargs"] = {
        "net_arch": list(NET_ARCH[hyperparams.pop("net_arch")]),
        "features_dim": hyperparams.pop("features_dim"),
    }
    return hyperparams


def merged(function: Callable[..., dict[str, Any]], policy_kwargs: Mapping[str, Any]) -> Callable[..., dict[str, Any]]:
    """
    A sampler or converter whose ``policy_kwargs`` are these with the drawn ones over them. The Zoo would drop these.
    """

    @wraps(function)
    def with_policy_kwargs(*args: Any, **kwargs: Any) -> dict[str, Any]:
        hyperparams = function(*args, **kwargs)
        return {**hyperparams, "policy_kwargs": {**policy_kwargs, **hyperparams.get("policy_kwargs", {})}}

    return with_policy_kwargs
