"""ModalityWeightsCallback: what it logs is what the agent weighed, and the run is the same with and without it."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, sensors_space, tiny_model, vectors_space
from PIL import Image
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_have import HAVESAC
from sb3_have.evaluation.recording import record_episode
from sb3_have.have import ModalityWeightsCallback


class Kept(KVWriter):
    """What was dumped, by step."""

    def __init__(self) -> None:
        self.dumps: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        excluded = {key for key, outputs in key_excluded.items() if outputs and "stdout" in outputs}
        self.dumps.append({key: value for key, value in key_values.items() if key not in excluded})

    def close(self) -> None: ...


class Acted(BaseCallback):
    """The weights at the observations that the agent acts on, read on its own account."""

    def __init__(self) -> None:
        super().__init__()
        self.weights: list[dict[str, np.ndarray]] = []

    def _on_rollout_start(self) -> None:
        self.seen = {key: value.copy() for key, value in self.model._last_obs.items()}  # type: ignore[union-attr]

    def _on_step(self) -> bool:
        self.weights.append(self.model.modality_weights(self.seen))  # type: ignore[attr-defined]
        return True


class Greedy(RandomSensors):
    """Takes its random numbers from everybody's generators."""

    def observe(self) -> Any:
        np.random.rand(), random.random(), th.rand(1)
        return super().observe()


def learn(model: HAVESAC, callback: Any, steps: int = 60, log_interval: int = 2) -> Kept:
    kept = Kept()
    model.set_logger(Logger(folder=None, output_formats=[kept]))
    model.learn(steps, callback=callback, log_interval=log_interval)
    return kept


def weights_of(model: HAVESAC) -> list[th.Tensor]:
    return [tensor for tensor in model.policy.state_dict().values() if isinstance(tensor, th.Tensor)]


def test_mean_weights_are_in_every_dump() -> None:
    model, acted = tiny_model(vectors_space(3)), Acted()
    kept = learn(model, [acted, ModalityWeightsCallback(read_freq=4, window=3)])
    assert len(kept.dumps) == 3  # 60 steps, episodes of 10, every second one
    for number, dump in enumerate(kept.dumps):
        end = 20 * (number + 1)
        read = list(range(0, end, 4))[-3:]
        for name in "abc":
            expected = np.mean([acted.weights[at][name] for at in read])
            assert dump[f"have/weight_{name}"] == pytest.approx(expected, rel=1e-6)
        assert sum(dump[f"have/weight_{name}"] for name in "abc") == pytest.approx(1, abs=1e-5)
    assert kept.dumps[0]["have/weight_a"] != kept.dumps[2]["have/weight_a"]


def test_a_dump_between_two_readings_has_the_weights_too() -> None:
    class Dumps(BaseCallback):
        def _on_step(self) -> bool:
            self.logger.dump(self.num_timesteps)
            return True

    kept = learn(tiny_model(vectors_space()), [ModalityWeightsCallback(read_freq=50), Dumps()], steps=12)
    assert len(kept.dumps) >= 12 and all("have/weight_a" in dump for dump in kept.dumps[:12])


@pytest.mark.parametrize("use_sde", [False, True])
def test_the_run_is_the_same_bit_for_bit(use_sde: bool, tmp_path: Path) -> None:
    def trained(callback: Any) -> HAVESAC:
        model = tiny_model(vectors_space(), env=Greedy(vectors_space()), use_sde=use_sde)
        learn(model, callback, steps=40)
        return model

    callback = ModalityWeightsCallback(
        read_freq=1, eval_env=Greedy(vectors_space(), length=7), episode_freq=9, folder=tmp_path
    )
    without, with_callback = trained(None), trained(callback)
    assert len(list(tmp_path.glob("weights-*.png"))) == 4
    for left, right in zip(weights_of(without), weights_of(with_callback), strict=True):
        assert th.equal(left, right)


def test_tensorboard_has_histograms_and_the_episode(tmp_path: Path) -> None:
    env = VecFrameStack(DummyVecEnv([lambda: RandomSensors(sensors_space())] * 2), 2)
    model = tiny_model(sensors_space(), env=env)
    model.set_logger(Logger(folder=None, output_formats=[TensorBoardOutputFormat(str(tmp_path))]))
    callback = ModalityWeightsCallback(
        read_freq=1, window=5, eval_env=RandomSensors(sensors_space(), length=30), episode_freq=30, max_steps=12
    )
    model.learn(50, callback=callback, log_interval=2)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    tags = events.Tags()
    assert {"have/weight_rgb", "have/weight_event", "have/weight_state"} <= set(tags["scalars"])
    assert set(tags["histograms"]) == {"have/weights_rgb", "have/weights_event", "have/weights_state"}
    histogram = events.Histograms("have/weights_rgb")[-1].histogram_value
    assert histogram.num == 5 * 2  # readings of two environments
    mean = events.Scalars("have/weight_rgb")[-1].value
    assert histogram.sum / histogram.num == pytest.approx(mean, rel=1e-5)
    (strip,) = events.Images("have/episode")
    assert strip.width > strip.height > 300 and strip.step == 40


def test_the_episode_is_that_of_the_evaluation_environment(tmp_path: Path) -> None:
    """Of vectors, normalised as in the training, whose statistics stay as they are."""
    env = VecNormalize(DummyVecEnv([lambda: RandomSensors(vectors_space())]))
    model = tiny_model(vectors_space(), env=env)
    learn(model, ModalityWeightsCallback(eval_env=RandomSensors(vectors_space(), 9), episode_freq=20, folder=tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {"weights-20.png", "weights-40.png", "weights-60.png"}
    with Image.open(tmp_path / "weights-60.png") as strip:
        assert strip.width > 600 and np.asarray(strip).std() > 10
    count = env.obs_rms["a"].count
    recording = record_episode(model, RandomSensors(vectors_space(), 9), seed=3)
    assert env.obs_rms["a"].count == count and len(recording.rewards) == 9
    normalised = env.normalize_obs({key: value[None] for key, value in recording.observations[4].items()})
    assert recording.weights["a"][4] == pytest.approx(model.modality_weights(normalised)["a"][0], rel=1e-5)


def test_steps_of_several_environments_do_not_jump_over_an_episode(tmp_path: Path) -> None:
    env: VecEnv = DummyVecEnv([lambda: RandomSensors(vectors_space())] * 3)
    model = tiny_model(vectors_space(), env=env)
    learn(
        model,
        ModalityWeightsCallback(eval_env=RandomSensors(vectors_space()), episode_freq=20, folder=tmp_path),
        steps=45,
    )
    assert {path.name for path in tmp_path.iterdir()} == {"weights-21.png", "weights-42.png"}


def test_without_a_place_for_it_no_episode_is_driven() -> None:
    env = RandomSensors(vectors_space())
    with pytest.warns(UserWarning, match="neither TensorBoard"):
        learn(tiny_model(vectors_space()), ModalityWeightsCallback(eval_env=env, episode_freq=5), steps=12)
    assert not hasattr(env, "steps")


def test_models_without_weights() -> None:
    model = tiny_model(vectors_space(), value_estimation="gve")
    with pytest.warns(UserWarning, match="gve"):
        kept = learn(model, ModalityWeightsCallback(), steps=30)
    assert kept.dumps and not any(key.startswith("have/") for dump in kept.dumps for key in dump)
    with pytest.raises(TypeError, match="SAC has no modality_weights"):
        SAC("MultiInputPolicy", RandomSensors(vectors_space()), buffer_size=10).learn(1, ModalityWeightsCallback())


def test_bad_arguments() -> None:
    for name in ("read_freq", "window"):
        with pytest.raises(ValueError, match=f"{name}=0"):
            ModalityWeightsCallback(**{name: 0})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="needs an eval_env"):
        ModalityWeightsCallback(episode_freq=10)
    env = RandomSensors(vectors_space())
    callback = ModalityWeightsCallback(eval_env=env, episode_freq=10)
    with pytest.raises(ValueError, match="training environment"):
        tiny_model(vectors_space(), env=env).learn(1, callback)


def test_an_environment_that_does_not_fit_is_refused_before_the_training(tmp_path: Path) -> None:
    other = RandomSensors(vectors_space(3))
    model = tiny_model(vectors_space())
    with pytest.raises(ValueError, match="do not fit the model"):
        model.learn(50, ModalityWeightsCallback(eval_env=other, episode_freq=1000, folder=tmp_path))
    assert model.num_timesteps == 0
