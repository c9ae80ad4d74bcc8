"""Trained drivers: what is shipped drives, and comes back as it was saved, in half the precision."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, sensors_space, tiny_model

from sb3_have import pretrained, record_episode, trained
from sb3_have.envs.weather import WEATHERS
from sb3_have.evaluation import evaluate


@pytest.mark.parametrize("name", trained.driver_names())
def test_a_shipped_driver_drives(name: str) -> None:
    """Straight ahead or with random actions, a car leaves this road or crashes within about 110 m."""
    policy = pretrained(name, "cpu")
    recording = record_episode(policy, policy.card["env_id"], "ClearNight", env_kwargs=policy.env_kwargs, max_steps=100)
    assert len(recording.infos) == 100 and recording.end["distance"] > 200
    assert not recording.values
    weights = np.array([*recording.weights.values()])
    assert recording.weights.keys() == set(policy.env_kwargs["modalities"])
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-5)
    assert (trained.FOLDER / f"{name}.safetensors").stat().st_size < 1.5e6
    assert policy.card["training"].keys() >= {"commit", "command", "steps", "seed", "machine", "versions"}
    assert policy.card["evaluation"]["distance_mean_lower_upper"].keys() == {*WEATHERS, "all"}


def test_drivers_have_names() -> None:
    assert "have" in trained.driver_names()
    with pytest.raises(ValueError, match="there is no driver 'hvae'; did you mean 'have'"):
        pretrained("hvae")


def test_what_was_saved_comes_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model(sensors_space())
    card: dict[str, Any] = {"env_id": "Some-v0", "env_kwargs": {"image_size": 36}}
    trained.save_driver(model.policy, "new", card, tmp_path / "drivers")
    monkeypatch.setattr(trained, "FOLDER", tmp_path / "drivers")

    before = th.get_rng_state()
    policy = pretrained("new", "cpu")
    assert th.equal(before, th.get_rng_state())
    assert policy.card == card and policy.env_kwargs == card["env_kwargs"]
    saved = dict(model.policy.named_parameters())
    for name, parameter in policy.actor.named_parameters():
        assert th.equal(parameter, saved[f"actor.{name}"].half().float())

    observation = model.observation_space.sample()
    expected, _ = model.predict(observation, deterministic=True)
    action, _ = policy.predict(observation, deterministic=True)
    np.testing.assert_allclose(action, expected, atol=5e-3)
    for key, weight in model.modality_weights(observation).items():
        np.testing.assert_allclose(policy.modality_weights(observation)[key], weight, atol=5e-3)


def test_frames_are_stacked_for_a_driver() -> None:
    policy = pretrained("have", "cpu")
    assert policy.observation_space["rgb"].shape == (9, 64, 64)  # type: ignore[index]
    with pytest.raises(ValueError, match="the environment's observations do not fit the model"):
        record_episode(policy, RandomSensors(sensors_space()))
    kwargs = {**policy.env_kwargs, "vehicles_count": 0}
    rows = evaluate(policy, policy.card["env_id"], ["ClearNoon"], 1, env_kwargs=kwargs)
    assert rows["distance_mean"][0] > 200
