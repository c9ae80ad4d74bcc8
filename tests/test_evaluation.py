"""Evaluation: every driver gets the same episodes, each counts once, and models read what they were trained on."""

import io
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from fake_drive import ENV_ID
from rich.console import Console
from rich.progress import Progress
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecTransposeImage,
)

from sb3_have.envs.drivers import KeepStraightDriver, RandomDriver
from sb3_have.evaluation.episodes import close
from sb3_have.evaluation.evaluation import evaluate, evaluate_episodes, format_table

WEATHERS = ("slow", "fast")


class Watcher:
    """Coasts, and keeps the shapes of its observations."""

    def __init__(self, observation_space: gym.Space[Any] | None = None) -> None:
        self.shapes: set[tuple[int, ...]] = set()
        self.batches: list[int] = []
        if observation_space is not None:
            self.observation_space = observation_space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        self.shapes.add(observation["rgb"].shape[1:])
        self.batches.append(len(observation["rgb"]))
        return np.zeros((len(observation["rgb"]), 2), np.float32), state


def fake_vec_env(**kwargs: Any) -> VecEnv:
    return DummyVecEnv([lambda: gym.make(ENV_ID, **kwargs)])


class Jerks(gym.Wrapper[Any, Any, Any, Any]):
    """Rewards the change from the last action, and keeps that array without copying it."""

    last: np.ndarray | None = None

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        jerk = 0.0 if self.last is None else float(np.abs(action - self.last).sum())
        self.last = action
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, jerk, terminated, truncated, info


def test_environments_may_keep_their_actions() -> None:
    """The array of actions is a new one in every step."""

    class Alternating(Watcher):
        sign = 1.0

        def predict(self, observation: Any, *args: Any, **kwargs: Any) -> tuple[np.ndarray, Any]:
            self.sign = -self.sign
            return np.full((len(observation["rgb"]), 2), self.sign, np.float32), None

    episodes = evaluate_episodes(Alternating(), ENV_ID, ["slow"], n_episodes=1, env_wrapper=Jerks)
    assert episodes["return"].tolist() == [4.0 * (episodes["steps"][0] - 1)]


def test_known_answers() -> None:
    """A coasting car earns its metres, so the statistics follow from the lengths of the episodes, seed % 5 + 4."""
    frame = evaluate(Watcher(), ENV_ID, WEATHERS, n_episodes=6, seed=3)
    episodes = evaluate_episodes(Watcher(), ENV_ID, WEATHERS, n_episodes=6, seed=3)
    assert list(frame["weather"]) == ["slow", "fast"]
    for row, metres in zip(frame.to_dict("records"), (1, 2), strict=True):
        lengths = episodes["seed"][episodes["weather"] == row["weather"]].to_numpy() % 5 + 4
        assert row["episodes"] == len(lengths) == 6
        for name in ("return", "distance"):
            assert row[f"{name}_mean"] == pytest.approx(metres * lengths.mean())
            assert row[f"{name}_std"] == pytest.approx(metres * lengths.std())
        assert row["steps_mean"] == pytest.approx(lengths.mean())
        assert row["crash_share"] == pytest.approx((lengths == 8).mean())
        assert row["offroad_share"] == 0


@pytest.mark.parametrize(
    "n_envs,vec_env_cls",
    [(2, SubprocVecEnv), (3, SubprocVecEnv), (2, DummyVecEnv), (3, DummyVecEnv), (99, DummyVecEnv)],
)
def test_result_does_not_depend_on_the_number_of_environments(n_envs: int, vec_env_cls: Any) -> None:
    """Counting whichever episodes end first would favour short ones."""
    options: dict[str, Any] = {"weathers": WEATHERS, "n_episodes": 4, "seed": 1}
    one = evaluate_episodes(KeepStraightDriver(3.0), ENV_ID, **options)
    several = evaluate_episodes(KeepStraightDriver(3.0), ENV_ID, **options, n_envs=n_envs, vec_env_cls=vec_env_cls)
    pd.testing.assert_frame_equal(one, several)
    assert one["return"].nunique() > 4


def test_an_environment_takes_the_next_episode_as_soon_as_it_can() -> None:
    """One ``predict`` for all environments; those without an episode are not in the batch."""
    watcher = Watcher()
    episodes = evaluate_episodes(watcher, ENV_ID, WEATHERS, n_episodes=6, seed=3, n_envs=5)
    assert sum(watcher.batches) == episodes["steps"].sum()
    assert len(watcher.batches) <= episodes["steps"].sum() / 5 + episodes["steps"].max()
    assert watcher.batches == sorted(watcher.batches, reverse=True) and watcher.batches[0] == 5


class Recurrent(Watcher):
    """Accelerates more in every step of an episode, which its state counts."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        actions, _ = super().predict(observation)
        (count,) = (np.zeros(len(actions)),) if state is None else state
        count = np.where(episode_start, 0, count) + 1
        actions[:, 0] = count / 10
        return actions, (count,)


@pytest.mark.parametrize("n_envs", [1, 5])
def test_recurrent_state_belongs_to_its_environment(n_envs: int) -> None:
    episodes = evaluate_episodes(Recurrent(), ENV_ID, ["slow"], n_episodes=8, seed=3, n_envs=n_envs)
    steps = episodes["steps"]
    np.testing.assert_allclose(episodes["return"], steps + steps * (steps + 1) / 20, rtol=1e-6)


def test_same_episodes_for_every_driver_others_in_every_weather() -> None:
    one = evaluate_episodes(RandomDriver(0), ENV_ID, WEATHERS, n_episodes=5, seed=7)
    other = evaluate_episodes(KeepStraightDriver(), ENV_ID, WEATHERS, n_episodes=5, seed=7)
    assert list(one["seed"]) == list(other["seed"]) and list(one["steps"]) == list(other["steps"])
    assert one["seed"].is_unique
    # The episodes of a weather do not depend on the other weathers
    alone = evaluate_episodes(RandomDriver(0), ENV_ID, ["fast"], n_episodes=5, seed=7)
    assert list(alone["seed"]) == list(one["seed"][one["weather"] == "fast"])
    again = evaluate_episodes(RandomDriver(0), ENV_ID, WEATHERS, n_episodes=5, seed=8)
    assert set(one["seed"]).isdisjoint(again["seed"])


def test_deterministic_in_the_seed() -> None:
    results = [evaluate(RandomDriver(4), ENV_ID, WEATHERS, n_episodes=3) for _ in range(2)]
    pd.testing.assert_frame_equal(results[0], results[1])
    assert not results[0].equals(evaluate(RandomDriver(5), ENV_ID, WEATHERS, n_episodes=3))


def test_unknown_facts_are_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    from fake_drive import FakeDrive

    monkeypatch.setattr(FakeDrive, "_info", lambda self: {})
    frame = evaluate(RandomDriver(), ENV_ID, ["slow"], n_episodes=1)
    assert frame[["distance_mean", "distance_std", "offroad_share"]].isna().all(axis=None)
    assert frame["return_mean"].notna().all()


@pytest.mark.parametrize("n_stack", [1, 3])
@pytest.mark.parametrize("transposed", [False, True])
def test_frames_are_stacked_and_transposed_for_the_model(n_stack: int, transposed: bool) -> None:
    vec_env = fake_vec_env()
    if n_stack > 1:
        vec_env = VecFrameStack(vec_env, n_stack)
    if transposed:
        vec_env = VecTransposeImage(vec_env)
    watcher = Watcher(vec_env.observation_space)
    evaluate(watcher, ENV_ID, ["slow"], n_episodes=1)
    assert watcher.shapes == {(3 * n_stack, 36, 36) if transposed else (36, 36, 3 * n_stack)}


def test_driver_without_space_gets_the_bare_environment() -> None:
    watcher = Watcher()
    evaluate(watcher, ENV_ID, ["slow"], n_episodes=1)
    assert watcher.shapes == {(36, 36, 3)}


def test_trained_model_with_frame_stack(tmp_path: Path) -> None:
    env = VecFrameStack(fake_vec_env(), 2)
    small = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
    model = SAC("MultiInputPolicy", env, buffer_size=10, policy_kwargs=small, device="cpu", seed=0)
    model.save(tmp_path / "model")
    frames = [evaluate(m, ENV_ID, ["fast"], n_episodes=2) for m in (model, SAC.load(tmp_path / "model", device="cpu"))]
    pd.testing.assert_frame_equal(frames[0], frames[1])


def test_wrong_spaces_are_explained() -> None:
    model = Watcher(VecFrameStack(fake_vec_env(image_size=40), 2).observation_space)
    with pytest.raises(ValueError, match=r"env_kwargs of the training(.|\n)*rgb: the model has .*40, 40, 6.*36, 36, 3"):
        evaluate(model, ENV_ID, ["slow"], n_episodes=1)
    only_rgb = Watcher(gym.spaces.Dict({"rgb": fake_vec_env().observation_space["rgb"]}))  # type: ignore[index]
    with pytest.raises(ValueError, match="depth: the model has None"):
        evaluate(only_rgb, ENV_ID, ["slow"], n_episodes=1)


@pytest.mark.parametrize("bad", [{"n_episodes": 0}, {"n_envs": 0}, {"weathers": ()}])
def test_bad_counts(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=">= 1"):
        evaluate(RandomDriver(), ENV_ID, **{"weathers": WEATHERS, "n_episodes": 1, **bad})


def test_keep_straight_driver_holds_its_speed() -> None:
    driver = KeepStraightDriver(target_speed=25.0)
    speed = 0.0
    for _ in range(100):
        driver.read_infos([{"speed": speed}])
        action, _ = driver.predict(None)
        assert action.shape == (2,) and action[1] == 0 and abs(action[0]) <= 1
        speed += 0.2 * 5.0 * float(action[0])  # 5 Hz, 5 m/s^2 at full throttle
    assert speed == pytest.approx(25.0, abs=0.01)


def test_drivers_without_their_infos() -> None:
    with pytest.raises(RuntimeError, match="read_infos"):
        KeepStraightDriver().predict(None)
    with pytest.raises(KeyError, match="speed"):
        KeepStraightDriver().read_infos([{}])


def test_random_driver_is_uniform() -> None:
    driver = RandomDriver(seed=1)
    actions = driver.predict(None, episode_start=np.zeros(4000, bool))[0]
    assert actions.shape == (4000, 2) and actions.dtype == np.float32
    counts, _ = np.histogram(actions, bins=8, range=(-1, 1))
    assert abs(counts - 1000).max() < 130  # 4.4 standard deviations of a binomial


def test_table() -> None:
    frame = pd.DataFrame(
        {
            "weather": ["slow", "fast"],
            "episodes": [1, 3],
            "return_mean": [0.0, 4.0],
            "return_std": [0.0, 2.0],
            "distance_mean": [10.0, 20.0],
            "distance_std": [0.0, 0.0],
        }
    )
    lines = format_table({"HAVE": frame, "random": frame}).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == ["weather", "", "HAVE", "random"]
    assert cells[2][:3] == ["slow", "ER", "0.0"]  # one episode has no deviation
    assert cells[5][1:3] == ["D [m]", "20 ± 0"]
    # all: mean (0 + 3 * 4) / 4, variance (9 + 3 * (4 + 1)) / 4
    assert cells[6][:3] == ["all", "ER", "3.0 ± 2.4"]
    assert len({len(line) for line in lines}) == 1
    with pytest.raises(ValueError, match="same weathers"):
        format_table({"HAVE": frame, "random": frame[:1]})


def test_the_progress_bar_is_seen_within_that_of_a_training(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    console = Console(file=terminal, stderr=True, force_terminal=True)
    monkeypatch.setattr("sys.stderr", terminal)
    with Progress(console=console) as progress:  # as SB3's progress bar does
        progress.add_task("training")
        evaluate(Watcher(), ENV_ID, ["slow"], n_episodes=2, progress_bar=True)
        assert "0/2 [" in terminal.getvalue()


def test_environments_that_were_interrupted_in_a_step_are_closed() -> None:
    env = SubprocVecEnv([lambda: gym.make(ENV_ID)] * 2)
    stacked = VecFrameStack(env, 2)
    stacked.reset()
    stacked.step_async(np.zeros((2, 2), np.float32))
    env.remotes[0].recv()  # the interruption came after the first answer
    close(stacked)
    assert env.closed and not any(process.is_alive() for process in env.processes)
