"""The quick study: each planted fault does what it says and is taken away again, and the study fails when it must."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import torch as th

from benchmarks import known_q, reliability, study_quick
from benchmarks.known_q import Measures, make_model
from benchmarks.planted_faults import FAULTS
from benchmarks.study_quick import DRIVING, KNOWN_Q, RECORD_SEEDS, SEEDS, Bound, Verdict, describe, judge
from sb3_have import HAVESAC, MultiModalCritic, MultiModalPolicy

GOOD = {
    "error": 0.1, "bias": 0.0, "std_ratio": 1.0, "correlation": 0.99, "local_error": 0.1, "negative_gradient": 0.0,
    "weight_auc": 1.0, "refusion_optimized": 1.0, "refusion_moved": 1.0,
}  # fmt: skip


def small_model() -> HAVESAC:
    """Untrained, with target networks that differ from the online ones."""
    model = make_model(0, learning_starts=64, buffer_size=64)
    th.manual_seed(1)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * th.randn_like(parameter))
    return model


@pytest.fixture
def model() -> HAVESAC:
    return small_model()


@pytest.fixture
def features(model: HAVESAC) -> th.Tensor:
    assert model.replay_buffer is not None
    with th.no_grad():
        encoded: th.Tensor = model.critic_target.encoder(model.replay_buffer.sample(32).next_observations)
    return encoded


def arguments(features: th.Tensor) -> dict[str, th.Tensor]:
    """Of ``_target_values``, with some ends."""
    generator = th.Generator().manual_seed(2)
    n_samples = len(features)
    return {
        "next_features": features,
        "next_actions": th.rand(n_samples, 2, generator=generator),
        "rewards": th.randn(n_samples, generator=generator),
        "discounts": known_q.GAMMA * (th.arange(n_samples) % 3 > 0).float(),
        "entropy_bonus": 0.5 + th.rand(n_samples, generator=generator),
    }


def target(model: HAVESAC, given: dict[str, th.Tensor], **changed: th.Tensor) -> th.Tensor:
    with th.no_grad():
        y: th.Tensor = model._target_values(**{**given, **changed})
    return y


def with_weights(model: HAVESAC, given: dict[str, th.Tensor], weights: th.Tensor) -> th.Tensor:
    """The target, by hand, with these weights (B, d) of the local values."""
    critic, z, actions = model.critic_target, given["next_features"], given["next_actions"]
    with th.no_grad():
        q_lve = (critic.local_critics(z, actions) * weights.t()).sum(dim=1)
        q: th.Tensor = critic.refusion(critic.global_critic(z, actions), q_lve, z).min(dim=0).values
    return given["rewards"] + given["discounts"] * (q + given["entropy_bonus"])


def test_target_by_hand(model: HAVESAC, features: th.Tensor) -> None:
    given = arguments(features)
    th.testing.assert_close(target(model, given), with_weights(model, given, model.critic_target.weights(features)))


@pytest.mark.parametrize(
    "fault,changed",
    [
        ("target_without_entropy", lambda given: {"entropy_bonus": th.zeros_like(given["rewards"])}),
        ("ends_ignored", lambda given: {"discounts": th.full_like(given["rewards"], known_q.GAMMA)}),
    ],
)
def test_target_with_other_arguments(
    model: HAVESAC, features: th.Tensor, fault: str, changed: Callable[[dict[str, th.Tensor]], dict[str, th.Tensor]]
) -> None:
    given = arguments(features)
    sound = target(model, given)
    with FAULTS[fault]():
        broken = target(model, given)
    assert th.equal(broken, target(model, given, **changed(given))) and not th.allclose(broken, sound)


def test_target_with_swapped_modalities(model: HAVESAC, features: th.Tensor) -> None:
    given = arguments(features)
    with FAULTS["swapped_modalities"]():
        broken = target(model, given)
    weights = model.critic_target.weights(features)
    th.testing.assert_close(broken, with_weights(model, given, weights.flip(1)))
    assert not th.allclose(weights, weights.flip(1), atol=0.05)


def test_target_with_weights_of_the_wrong_step(model: HAVESAC, features: th.Tensor) -> None:
    given = arguments(features)
    assert model.replay_buffer is not None
    observations = model.replay_buffer.sample(32).observations
    with FAULTS["weights_of_wrong_step"]():
        now = model.policy.encode(observations)
        broken = target(model, given)
    weights = model.critic_target.weights(now).detach()
    th.testing.assert_close(broken, with_weights(model, given, weights))
    assert not th.allclose(weights, model.critic_target.weights(features), atol=0.05)


def test_target_with_frozen_local_critics(model: HAVESAC, features: th.Tensor) -> None:
    given = arguments(features)
    with FAULTS["frozen_local_targets"]():
        before = target(model, given)
        with th.no_grad():
            for parameter in model.critic_target.local_critics.parameters():
                parameter.add_(0.1)
        assert th.equal(target(model, given), before)
    assert not th.allclose(target(model, given), before)


def test_unsupervised_locals(model: HAVESAC, features: th.Tensor) -> None:
    values = model.critic.values(features, th.zeros(len(features), 2))
    y = th.ones(len(features))
    with FAULTS["unsupervised_locals"]():
        broken = model._critic_loss(values, y).item()
    sound = model._critic_loss(values, y).item()
    assert broken == pytest.approx(0.5 * (values.q - y).square().mean(dim=1).sum().item())
    assert sound > broken and model.local_coef == 1


@pytest.mark.parametrize("fault,in_optimizer", [("frozen_refusion", False), ("detached_refusion", True)])
def test_refusion_that_does_not_learn(fault: str, in_optimizer: bool) -> None:
    with FAULTS[fault]():
        model = small_model()
        before = {name: value.clone() for name, value in model.critic.state_dict().items()}
        model.train(2, batch_size=16)
    optimized = {id(parameter) for group in model.critic.optimizer.param_groups for parameter in group["params"]}
    for name, parameter in model.critic.named_parameters():
        is_refusion = name.startswith("refusion")
        assert th.equal(parameter, before[name]) == is_refusion, name
        assert (id(parameter) in optimized) == (in_optimizer or not is_refusion), name


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_go_again_and_leave_other_forms_alone(fault: str) -> None:
    def methods() -> list[Any]:
        owned: list[tuple[Any, str]] = [(HAVESAC, name) for name in ("_target_values", "_critic_loss", "train")]
        owned += [(MultiModalPolicy, "encode"), (MultiModalPolicy, "_build")]
        owned += [(MultiModalCritic, "values"), (MultiModalCritic, "min_q")]
        return [getattr(owner, name) for owner, name in owned]

    sound = methods()
    with pytest.raises(RuntimeError, match="inside"), FAULTS[fault]():
        assert methods() != sound
        raise RuntimeError("inside")
    assert methods() == sound


@pytest.mark.parametrize(
    "values,worst,ok",
    [
        ([0.1, -0.15], -0.15, True),
        ([0.1, 0.21], 0.21, False),
        ([0.3, -0.4], -0.4, False),
        ([0.1, math.nan, 5.0], math.nan, False),
        ([-0.2, 0.0], -0.2, True),
    ],
)
def test_the_worst_seed_counts(values: list[float], worst: float, ok: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(study_quick.SUITES, "driving", (Bound("bias", -0.2, 0.2, ""),))
    (verdict,) = judge("driving", [{"bias": value} for value in values])
    assert verdict.worst == pytest.approx(worst, nan_ok=True) and verdict.ok is ok


def test_the_mean_return_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """One seed may be below the return of doing nothing; a driver that does nothing fails."""

    def verdict(*returns: float) -> Verdict:
        drives = [{"final_return": value, "weight_auc": 1.0, "negative_gradient": 0.0} for value in returns]
        return judge("driving", drives)[0]

    assert verdict(58.0, 72.0).ok and verdict(58.0, 72.0).worst == 65
    assert not verdict(59.4, 59.4).ok and not verdict(99.0, math.nan).ok
    assert "final_return (mean)" in describe([verdict(58.0, 72.0)])


def test_actor_that_descends(model: HAVESAC, features: th.Tensor) -> None:
    """The target is what it was, and the actor's step goes the other way."""
    given, actions = arguments(features), th.zeros(len(features), 2)
    sound = target(model, given), model.critic.min_q(features, actions)
    with FAULTS["reversed_actor"]():
        assert th.equal(target(model, given), sound[0])
        assert th.equal(model.critic.min_q(features, actions), -sound[1])


def test_bounds_fit_what_is_measured() -> None:
    assert {bound.measure for bound in KNOWN_Q} == set(Measures.__annotations__) - {"seconds"} == GOOD.keys()
    assert all(verdict.ok for verdict in judge("known Q", [GOOD]))
    assert all(bound.lower <= bound.upper and bound.suspects for bound in (*KNOWN_Q, *DRIVING))


def test_description_names_what_is_out_of_bounds() -> None:
    text = describe(judge("known Q", [{**GOOD, "std_ratio": 0.5}]))
    (line,) = [line for line in text.splitlines() if line.startswith("OUT OF BOUNDS")]
    assert "known Q, std_ratio 0.500" in line and "weights" in line
    assert sum(line.endswith("NO") for line in text.splitlines()) == 1


class SameProcess:
    """In place of the pool of processes, so that what a test has patched is in effect."""

    def __init__(self, *args: Any, **kwargs: Any) -> None: ...

    def __enter__(self) -> "SameProcess":
        return self

    def __exit__(self, *args: object) -> None: ...

    map = staticmethod(map)


def fake_runs(monkeypatch: pytest.MonkeyPatch, bad_when: Callable[[], bool]) -> list[tuple[str, int]]:
    """Trainings that measure good values, and a bad weight AUC if ``bad_when``; returns the list of them."""
    runs: list[tuple[str, int]] = []
    good_drive = {bound.measure: bound.lower for bound in DRIVING}

    def run(seed: int) -> SimpleNamespace:
        runs.append(("known Q", seed))
        return SimpleNamespace(**{**GOOD, **({"weight_auc": 0.6} if bad_when() else {})})

    def run_small(seeds: list[int], n_updates: int, n_workers: int) -> pd.DataFrame:
        runs.extend(("driving", seed) for seed in seeds)
        return pd.DataFrame([good_drive], index=seeds)

    monkeypatch.setattr(study_quick, "ProcessPoolExecutor", SameProcess)
    monkeypatch.setattr(known_q, "run", run)
    monkeypatch.setattr(reliability, "run_small", run_small)
    return runs


def run_main(monkeypatch: pytest.MonkeyPatch, *args: str) -> object:
    monkeypatch.setattr("sys.argv", ["study_quick", *args])
    with pytest.raises(SystemExit) as exit_info:
        study_quick.main()
    return exit_info.value.code


SOUND: Mapping[str, Any] = {name: getattr(HAVESAC, name) for name in ("_target_values", "_critic_loss")}


def is_broken(method: str) -> bool:
    return getattr(HAVESAC, method) is not SOUND[method]


def test_sound_code_passes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    runs = fake_runs(monkeypatch, bad_when=lambda: is_broken("_critic_loss"))
    assert run_main(monkeypatch) == 0
    assert runs == [("known Q", seed) for seed in SEEDS] + [("driving", seed) for seed in SEEDS[:2]]
    assert "Passed" in capsys.readouterr().out


def test_a_planted_fault_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    runs = fake_runs(monkeypatch, bad_when=lambda: is_broken("_critic_loss"))
    assert run_main(monkeypatch, "--fault", "unsupervised_locals", "--seeds", "4") == 1
    assert runs == [("known Q", 4)]
    assert "FAILED: known Q weight_auc" in capsys.readouterr().out
    assert not is_broken("_critic_loss")


def test_driving_out_of_bounds_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a fault that only driving shows."""
    fake_runs(monkeypatch, bad_when=lambda: False)
    good = reliability.run_small

    def run_small(seeds: list[int], n_updates: int, n_workers: int) -> pd.DataFrame:
        return good(seeds, n_updates, n_workers) * (math.nan if is_broken("_critic_loss") else 1)

    monkeypatch.setattr(reliability, "run_small", run_small)
    assert run_main(monkeypatch, "--fault", "unsupervised_locals") == 1
    assert run_main(monkeypatch) == 0


@pytest.mark.parametrize("found", [True, False])
def test_record(found: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Every case is written down; a fault that is not found, or a sound study that fails, is an error."""

    def study(pool: object, seeds: tuple[int, ...], fault: str | None) -> list[Verdict]:
        bad = fault is not None and (found or fault != "frozen_refusion")
        return judge("known Q", [{**GOOD, "error": 9.0} if bad else GOOD])

    monkeypatch.setattr(study_quick, "RECORD", tmp_path)
    monkeypatch.setattr(study_quick, "study", study)
    monkeypatch.setattr(study_quick, "ProcessPoolExecutor", SameProcess)
    assert (run_main(monkeypatch, "--record") is None) == found
    assert (run_main(monkeypatch, "--record", "frozen_refusion") is None) == found  # in place of the same row
    table = pd.read_csv(tmp_path / "faults.csv")
    assert len(table) == (len(FAULTS) + len(RECORD_SEEDS)) * len(KNOWN_Q)
    codes = table.groupby("study")["exit_code"].max()
    assert codes["sound"] == 0 and codes["swapped_modalities"] == 1 and codes["frozen_refusion"] == found
    text = (tmp_path / "faults.md").read_text()
    assert text.count("OUT OF BOUNDS") == len(FAULTS) - (not found)
    assert text.index("## sound") < text.index("## swapped_modalities")
    assert all((fault.__doc__ or "?") in text for fault in FAULTS.values())
