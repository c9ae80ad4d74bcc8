"""The benchmarks of speed and memory: equal contenders on equal data, and parts that are what they are called."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch as th
from stable_baselines3.common.type_aliases import DictReplayBufferSamples

from benchmarks import event_speed, replay_memory, update_speed
from benchmarks.measure import Times, interleave, save
from benchmarks.random_sensors import CHANNELS, make_env
from sb3_have import HAVESAC

SHAPE = update_speed.Shape(image_size=36, batch_size=4, rounds=2, modalities=(2,))
TWO = {key: CHANNELS[key] for key in ("rgb", "event")}


@pytest.fixture(autouse=True)
def small_buffers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(update_speed, "BUFFER_SIZE", 8)


def have_sac() -> tuple[HAVESAC, DictReplayBufferSamples]:
    env = make_env(TWO, SHAPE.image_size)
    model = update_speed.have_sac(env, "float32", "cpu")
    update_speed.ready([model], env)
    assert model.replay_buffer is not None
    batch = model.replay_buffer.sample(SHAPE.batch_size)
    assert isinstance(batch, DictReplayBufferSamples)
    return model, batch


def test_update_speed_has_a_row_for_every_contender_and_part() -> None:
    rows = update_speed.measure(SHAPE, modalities=2, precisions=["float32"])
    table = pd.DataFrame(rows).set_index("contender")
    assert set(table.index) == {
        "SB3 SAC", "SB3 SAC shared", "HAVESAC", "HAVESAC no auxiliary", "encoders", "decoding", "sampling", "heads",
        "rest",
    }  # fmt: skip
    assert (table["rounds"] == 2).all() and (table["modalities"] == 2).all()
    assert table.loc[["HAVESAC", "HAVESAC no auxiliary"], ["vs_sb3", "vs_sb3_shared", "vs_floor"]].gt(0).all(axis=None)


def test_the_rest_is_the_step_less_its_parts_and_ratios_are_within_a_round() -> None:
    in_rounds = {
        "SB3 SAC": [100, 200, 300], "HAVESAC": [20, 40, 30], "encoders": [10, 10, 10], "decoding": [2, 2, 2],
        "sampling": [1, 1, 1],
    }  # fmt: skip
    times = {(name, "float32"): Times(np.array(ms, float), np.array(ms, float)) for name, ms in in_rounds.items()}
    table = pd.DataFrame(update_speed.summary(times, ["float32"])).set_index("contender")
    assert table.loc["rest", "median_ms"] == 17
    assert table.loc["HAVESAC", "vs_sb3"] == 5  # median of 5, 5, 10
    assert table.loc["HAVESAC", "vs_floor"] == 3
    assert table.loc["encoders", "share"] == pytest.approx(1 / 3, abs=1e-3)


def test_encoders_of_sb3_have_the_layers_of_havesac() -> None:
    model, _ = have_sac()
    plain = update_speed.PlainEncoders(model.observation_space)  # type: ignore[arg-type]
    shapes = [parameter.shape for parameter in plain.parameters()]
    assert shapes == [parameter.shape for parameter in model.critic.encoder.parameters()]


def test_the_floor_runs_and_trains_the_encoders_of_the_step() -> None:
    model, batch = have_sac()
    encoder = model.critic.encoder
    th.testing.assert_close(update_speed.on_decoded(encoder, batch.observations)(), encoder(batch.observations))
    update_speed.encoders_alone(model, batch)()
    assert all(parameter.grad is not None for parameter in encoder.parameters())
    assert all(parameter.grad is None for parameter in model.critic_target.encoder.parameters())


def test_replay_memory_measures_what_the_buffers_hold() -> None:
    setting = replay_memory.Setting(image_size=36, episode_length=5, transitions=40)
    names = (replay_memory.SB3, "ModalityReplayBuffer")
    sb3, ours = replay_memory.measure(setting, names, batch_size=4, rounds=2)
    frame = 36 * 36 * 8
    assert sb3["held_per_transition"] == pytest.approx(6 * frame, rel=0.01)
    assert frame < ours["held_per_transition"] < 2.5 * frame
    assert sb3["transitions"] == ours["transitions"] == 40


def test_both_buffers_are_filled_with_the_same() -> None:
    setting = replay_memory.Setting(image_size=36, episode_length=5, transitions=40)
    batches = []
    for name in (replay_memory.SB3, "ModalityReplayBuffer"):
        np.random.seed(0)
        batches.append(replay_memory.filled(name, setting).sample(16))
    for batch in batches[1:]:
        th.testing.assert_close(batch._asdict(), batches[0]._asdict())


def test_interleave_visits_all_contenders_every_round() -> None:
    visits: list[str] = []
    times = interleave({name: lambda name=name: visits.append(name) for name in "abc"}, rounds=4, warm_up=1)  # type: ignore[misc]
    assert [sorted(visits[start : start + 3]) for start in range(0, 15, 3)] == [["a", "b", "c"]] * 5
    assert all(len(ms) == 4 for ms in times["a"])


def test_save_replaces_only_what_was_measured_anew(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    save([{"shape": "a", "ms": 1.0}, {"shape": "b", "ms": 2.0}], path, ["shape"])
    save([{"shape": "a", "ms": 3.0}], path, ["shape"])
    assert dict(pd.read_csv(path).to_numpy().tolist()) == {"a": 3.0, "b": 2.0}


def test_event_speed_has_a_row_for_every_camera() -> None:
    contenders = [
        event_speed.Contender("setting", setting, image_size=32, output=output)
        for setting in event_speed.SETTINGS
        for output in ("sorted", "unsorted")
    ]
    rows = event_speed.measure(contenders, rounds=2, repeats=4)
    assert [(row["setting"], row["output"]) for row in rows] == [(c.setting, c.output) for c in contenders]
    assert all(row["median_ms"] > 0 and row["ns_per_event"] > 0 for row in rows)
    events = {(row["setting"], row["output"]): row["events"] for row in rows}
    assert events["ideal", "sorted"] == events["ideal", "unsorted"] > 0  # the same film, and noise of the same seed
    assert events["noisy", "sorted"] == events["noisy", "unsorted"] > events["carla", "sorted"]


def test_the_film_goes_round_without_a_jump() -> None:
    film = event_speed.film(image_size=40, contrast=0.3)
    steps = np.abs(np.log(np.roll(film, -1, axis=0)) - np.log(film)).mean(axis=(1, 2))
    assert film.shape == (event_speed.FRAMES, 40, 40) and steps.min() > 0
    assert steps.max() < 1.2 * steps.min()
