"""What a week of use does, in random order and with failing sensors: train, evaluate, record, save, resume, export."""

import gc
import logging
import multiprocessing
import os
import random
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

from sb3_have import (
    HAVESAC,
    evaluate,
    export_onnx,
    export_safetensors,
    load_checkpoint,
    load_policy,
    record_episode,
    save_checkpoint,
)
from sb3_have.envs.weather import WEATHERS
from sb3_have.sensors.failures import failures_for
from sb3_have.sensors.sensor_failure import SensorFailure

ENV_ID = "HighwayVision-v0"
MODALITIES = ("rgb", "event", "depth")
# Every kind of failure of every sensor at every severity, in random order
FAILURES = [(name, kind, severity) for name in MODALITIES for kind in failures_for(name) for severity in (1, 2, 3)]
random.Random(0).shuffle(FAILURES)
# Steps of an episode
STEPS = 12


class Week(RuleBasedStateMachine):
    """One model at a time, in one environment; ``samples`` collects what the process holds after each episode."""

    week = 0
    samples: list[tuple[int, int, int]]
    model: Any

    @initialize(
        others=st.sets(st.sampled_from(MODALITIES)),
        scenario=st.sampled_from(["highway", "merge", "curves"]),
    )
    def start(self, others: set[str], scenario: str) -> None:
        # Each week has another failure, so that all of them have their turn
        modality, kind, severity = FAILURES[Week.week % len(FAILURES)]
        Week.week += 1
        modalities = sorted({modality, *others})
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name)
        self.kwargs: dict[str, Any] = {
            "modalities": modalities,
            "scenario": scenario,
            "image_size": 16,
            "vehicles_count": 4,
        }
        self.kwargs |= {"max_episode_steps": STEPS, "initial_speed": 15.0}
        self.wrapper = partial(SensorFailure, modality=modality, kind=kind, severity=severity, probability=0.3)
        self.model = HAVESAC(
            "MultiInputPolicy",
            self.make_env(),
            buffer_size=100,
            learning_starts=10,
            batch_size=8,
            seed=0,
            device="cpu",
            policy_kwargs={"features_dim": 4, "net_arch": [8]},
        )
        self.model.learn(STEPS)

    def make_env(self) -> VecFrameStack:
        """One environment as in training: any weather, a failing sensor, two stacked frames."""
        env = self.wrapper(gym.make(ENV_ID, weather="random", **self.kwargs))
        return VecFrameStack(DummyVecEnv([lambda: Monitor(env)]), 2)

    def observation(self) -> Any:
        return self.model.observation_space.sample()

    @rule(weather=st.sampled_from(WEATHERS), vec_env_cls=st.sampled_from([*[DummyVecEnv] * 5, SubprocVecEnv]))
    def evaluate(self, weather: str, vec_env_cls: Any) -> None:
        kwargs: dict[str, Any] = {"env_kwargs": self.kwargs, "env_wrapper": self.wrapper, "vec_env_cls": vec_env_cls}
        rows = evaluate(self.model, ENV_ID, [weather], 1, **kwargs)
        assert np.isfinite(rows["return_mean"][0]) and rows["steps_mean"][0] <= STEPS

    @rule(weather=st.sampled_from(WEATHERS), seed=st.integers(0, 99))
    def record(self, weather: str, seed: int) -> None:
        recording = record_episode(self.model, ENV_ID, weather, seed, self.kwargs, env_wrapper=self.wrapper)
        assert len(recording.observations) == len(recording.rewards) <= STEPS

    @rule()
    def train(self) -> None:
        before = self.model.num_timesteps
        self.model.learn(STEPS, reset_num_timesteps=False)
        assert self.model.num_timesteps == before + STEPS

    @rule()
    def save_and_load(self) -> None:
        """A loaded model has an empty replay buffer, so it collects steps before it learns again."""
        observation = self.observation()
        expected, _ = self.model.predict(observation, deterministic=True)
        self.model.save(self.path / "model")
        self.model = HAVESAC.load(self.path / "model", self.model.get_env(), device="cpu", learning_starts=10)
        np.testing.assert_array_equal(self.model.predict(observation, deterministic=True)[0], expected)

    @rule()
    def resume(self) -> None:
        save_checkpoint(self.model, self.path / "checkpoint")
        old, self.model = self.model, load_checkpoint(self.path / "checkpoint", self.make_env(), device="cpu")
        assert (
            self.model.num_timesteps == old.num_timesteps
            and self.model.replay_buffer.size() == old.replay_buffer.size()
        )
        old.get_env().close()

    @rule()
    def export(self) -> None:
        observation = self.observation()
        expected, _ = self.model.predict(observation, deterministic=True)
        export_safetensors(self.model, self.path / "policy")
        action, _ = load_policy(self.path / "policy", "cpu").predict(observation, deterministic=True)
        np.testing.assert_array_equal(action, expected)
        export_onnx(self.model, self.path / "policy.onnx")

    def teardown(self) -> None:
        if hasattr(self, "model"):
            self.model.get_env().close()
            self.folder.cleanup()
        if sys.platform == "linux":
            # With so many objects, Python itself collects cycles only when they are a quarter of all
            gc.collect()
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            files = len(os.listdir("/proc/self/fd"))
            self.samples.append((resident, files, len(multiprocessing.active_children())))


def soak(weeks: int, actions: int) -> np.ndarray:
    """Live through some weeks; return resident memory [bytes], open files and processes after each of them."""
    Week.week, Week.samples = 0, []
    limits = settings(
        max_examples=weeks,
        stateful_step_count=actions,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(Week, settings=limits)
    return np.array(Week.samples)


def test_soak() -> None:
    soak(weeks=4, actions=4)


@pytest.mark.study
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_soak_thoroughly(monkeypatch: pytest.MonkeyPatch) -> None:
    """All failures, and more than 200 episodes; nothing grows over the second half."""
    # pytest attaches its handlers to this logger, which makes PyTorch trace every export, and keeps the messages
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "handlers", [])
    samples = soak(weeks=len(FAILURES), actions=6)
    memory, files, processes = samples[len(samples) // 2 :].T
    print(f"resident {memory[0] / 1e6:.0f} to {memory[-1] / 1e6:.0f} MB, {files[-1]} files, {processes[-1]} processes")
    assert memory.max() < 1.05 * memory.min()
    assert len(set(files)) == 1 and not processes.any()
