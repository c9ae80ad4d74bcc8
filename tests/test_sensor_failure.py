"""SensorFailure: what happened is what info says, when it should have happened, and nothing else changed."""

import copy
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from numpy.typing import NDArray
from stable_baselines3.common.env_checker import check_env as check_env_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

from sb3_have.sensors import FAILURES, SensorFailure, failures_for
from tests.envs import TINY, image, vector

Array = NDArray[Any]
Env = gym.Env[Any, Any]
SPACE = spaces.Dict({"rgb": image(3, 20), "event": image(5, 20), "depth": image(1, 20), "state": vector(6)})
SENSOR_OF = {"rgb": "rgb", "event": "event", "depth": "depth", "state": "vector"}
PAIRS = [(kind, key) for key, sensor in SENSOR_OF.items() for kind in failures_for(sensor)]


class Scenes(gym.Env[Any, Any]):
    """Random images and vectors, written into the same arrays step after step as some simulators do."""

    def __init__(self, space: spaces.Space[Any] = SPACE, length: int = 12) -> None:
        self.observation_space = space
        self.action_space = spaces.Discrete(2)
        self.length = length
        self.buffers: dict[str, Array] = {
            key: np.zeros(box.shape, box.dtype) for key, box in SPACE.items() if isinstance(box, spaces.Box)
        }

    def observe(self) -> Any:
        for key, buffer in self.buffers.items():
            uniform = self.np_random.uniform(-1, 1, buffer.shape)
            buffer[...] = uniform if key == "state" else 128 + 127 * uniform
        return self.buffers if isinstance(self.observation_space, spaces.Dict) else self.buffers["rgb"]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observe(), {"own": 1}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self.observe(), 1.0, False, self.steps == self.length, {"own": 2}


class Remembers(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps a copy of what goes by, to compare with what comes out further up."""

    def reset(self, **kwargs: Any) -> Any:
        self.given, info = self.env.reset(**kwargs)
        self.seen = copy.deepcopy(self.given)
        return self.given, info

    def step(self, action: Any) -> Any:
        self.given, *rest = self.env.step(action)
        self.seen = copy.deepcopy(self.given)
        return self.given, *rest


def rollout(env: Env, steps: int = 12, seed: int | None = 0) -> tuple[list[Any], list[Any]]:
    """Observations and the truths of ``steps`` steps, a new episode whenever one is over."""
    env.action_space.seed(seed)
    observation, info = env.reset(seed=seed)
    observations, truths = [copy.deepcopy(observation)], [info["sensor_failure"]]
    for _ in range(steps):
        observation, _, terminated, truncated, info = env.step(env.action_space.sample())
        if terminated or truncated:
            observation, info = env.reset()
        observations.append(copy.deepcopy(observation))
        truths.append(info["sensor_failure"])
    return observations, truths


def active(truths: list[Any], modality: str = "rgb", name: str = "black") -> Array:
    return np.array([truth[modality][name]["active"] for truth in truths])


def same(a: dict[str, Array], b: dict[str, Array]) -> bool:
    return all((a[key] == b[key]).all() for key in b)


@pytest.mark.parametrize("severity", [1, 2, 3])
@pytest.mark.parametrize("kind, key", PAIRS)
def test_the_truth_is_what_happened(kind: str, key: str, severity: int) -> None:
    below = Remembers(Scenes())
    env = SensorFailure(below, key, kind, severity, probability=0.5)
    assert env.observation_space == SPACE
    observation, info = env.reset(seed=3)
    happened = []
    for step in range(12):
        assert SPACE.contains(observation)
        assert same(below.given, below.seen)  # nothing was written into the environment's arrays
        assert all((observation[name] == below.seen[name]).all() for name in SPACE if name != key)
        truth = info["sensor_failure"][key][kind]
        assert info["own"] and truth.keys() == {"kind", "severity", "active"}
        assert truth["kind"] == kind and truth["severity"] == severity and type(truth["active"]) is bool
        # On the first step the sensors with a memory have nothing older to show.
        expected = truth["active"] and (kind not in ("frozen", "lag") or step > 0)
        assert (observation[key] != below.seen[key]).any() == expected
        happened.append(truth["active"])
        observation, _, _, _, info = env.step(0)
    assert 0 < sum(happened) < 12


def test_it_fails_always_unless_told_otherwise() -> None:
    assert active(rollout(SensorFailure(Scenes(), "rgb", "black"))[1]).all()
    assert not active(rollout(SensorFailure(Scenes(), "rgb", "black", probability=0.0))[1]).any()


def test_frozen_repeats_the_last_image_before_the_failure() -> None:
    below = Remembers(Scenes())
    env = SensorFailure(below, "rgb", "frozen", severity=3, schedule=[(3, 6), (8, None)])
    for episode in range(2):  # the second knows nothing of the first
        env.reset(seed=episode)
        held, shown = below.seen["rgb"], []
        for step in range(1, 12):
            observation, *_ = env.step(0)
            if not (3 <= step < 6 or step >= 8):
                held = below.seen["rgb"]
            np.testing.assert_array_equal(observation["rgb"], held)
            shown.append(observation["rgb"])
            observation["rgb"][...] = 0  # what the caller does with it is no concern of the next step
        assert env.observation_space.contains(observation)
    env = SensorFailure(below, "rgb", "frozen", severity=3)
    first = env.reset(seed=0)[0]["rgb"].copy()
    for _ in range(5):
        np.testing.assert_array_equal(env.step(0)[0]["rgb"], first)


@pytest.mark.parametrize("severity, steps", [(1, 1), (2, 2), (3, 4)])
def test_lag_shows_the_image_of_some_steps_ago(severity: int, steps: int) -> None:
    below = Remembers(Scenes())
    env = SensorFailure(below, "event", "lag", severity, schedule=(2, None))
    for episode in range(2):
        env.reset(seed=episode)
        past = [below.seen["event"]]
        for step in range(1, 12):
            observation, *_ = env.step(0)
            past.append(below.seen["event"])
            shown = past[max(0, step - steps)] if step >= 2 else past[step]
            np.testing.assert_array_equal(observation["event"], shown)
            observation["event"][...] = 0  # what the caller does with it is no concern of the next step


def test_steps_fail_with_their_probability() -> None:
    for probability in (0.1, 0.6):
        env = SensorFailure(Scenes(length=20), "rgb", "black", probability=probability)
        failing = active(rollout(env, 3000)[1])
        assert failing.mean() == pytest.approx(probability, abs=4 * np.sqrt(0.25 / 3000))
        after = failing[1:][failing[:-1]].mean()  # no memory
        assert after == pytest.approx(probability, abs=0.1)


@pytest.mark.parametrize("probability, duration", [(0.2, 8.0), (0.5, 3.0), (0.05, 1.0)])
def test_segments_keep_the_share_and_have_their_length(probability: float, duration: float) -> None:
    env = SensorFailure(Scenes(length=10**6), "rgb", "black", probability=probability, duration=duration)
    failing = active(rollout(env, 8000)[1])
    edges = np.flatnonzero(np.diff(failing.astype(int), prepend=0) == 1)
    assert failing.sum() / len(edges) == pytest.approx(duration, rel=0.15)
    assert failing.mean() == pytest.approx(probability, rel=0.2)


def test_segments_fail_as_often_at_the_reset() -> None:
    env = SensorFailure(Scenes(), "rgb", "black", probability=0.3, duration=10)
    env.reset(seed=0)
    first = np.mean([env.reset()[1]["sensor_failure"]["rgb"]["black"]["active"] for _ in range(2000)])
    assert first == pytest.approx(0.3, abs=0.05)


def test_episodes_fail_as_a_whole() -> None:
    env = SensorFailure(Scenes(length=5), "rgb", "black", probability=0.3, per="episode")
    episodes = active(rollout(env, 5 * 1000 - 1)[1]).reshape(-1, 5)
    assert (episodes == episodes[:, :1]).all()
    assert episodes[:, 0].mean() == pytest.approx(0.3, abs=0.06)


def every_third(step: int) -> bool:
    return step % 3 == 1


@pytest.mark.parametrize(
    "schedule, steps",
    [
        ((2, 5), {2, 3, 4}),
        ([2, 5], {2, 3, 4}),  # as YAML has it
        ((0, 1), {0}),
        ((9, None), {9, 10, 11}),
        ([(1, 2), (4, 6)], {1, 4, 5}),
        ([[1, 2], [1, 3]], {1, 2}),
        (every_third, {1, 4, 7, 10}),
    ],
)
def test_schedules_are_exact_in_every_episode(schedule: Any, steps: set[int]) -> None:
    env = SensorFailure(Scenes(), "rgb", "black", schedule=schedule)
    failing = active(rollout(env, 2 * 12 - 1)[1]).reshape(2, 12)
    for episode in failing:
        assert set(np.flatnonzero(episode)) == steps


def test_chips_stay_the_same_and_differ_by_seed() -> None:
    def dead(chip: int, seed: int | None) -> list[Array]:
        below = Remembers(Scenes())
        env = SensorFailure(below, "rgb", "dead_pixels", seed=chip)
        env.reset(seed=seed)
        masks = []
        for _ in range(6):
            observation = env.step(0)[0]
            stuck = np.isin(observation["rgb"], (0, 255)).all(axis=-1)
            changed = (observation["rgb"] != below.seen["rgb"]).any(axis=-1)
            assert not (changed & ~stuck).any()
            masks.append(changed)
        return masks

    chips = []
    for chip in (0, 1):
        masks = [mask for seed in (0, 7, None) for mask in dead(chip, seed)]
        assert masks[0].sum() == 20 * 20 * 0.05
        assert all((mask == masks[0]).all() for mask in masks)
        chips.append(masks[0])
    assert (chips[0] != chips[1]).any()

    def offset(seed: int) -> Array:
        env = SensorFailure(Remembers(Scenes()), "rgb", "misalignment", severity=3, seed=seed)
        return np.asarray(env.reset(seed=0)[0]["rgb"])

    assert len({offset(seed).tobytes() for seed in range(12)}) > 4
    np.testing.assert_array_equal(offset(3), offset(3))


def test_the_same_seed_gives_the_same_bits() -> None:
    def make(severity: int = 2) -> Env:
        env: Env = Scenes()
        for key, kind in (("rgb", "noise"), ("rgb", "motion_blur"), ("event", "event_storm"), ("state", "noise")):
            env = SensorFailure(env, key, kind, severity, probability=0.5, duration=3)
        return env

    env = make()
    first, truths = rollout(env, 40)
    for again in (env, make(), pickle.loads(pickle.dumps(env))):
        observations, told = rollout(again, 40)
        assert told == truths
        assert all(same(a, b) for a, b in zip(observations, first, strict=True))
    other, told = rollout(env, 40, seed=1)
    assert told != truths and not same(other[5], first[5])
    harder = rollout(make(3), 40)[1]
    for key, kind in (("rgb", "noise"), ("event", "event_storm")):
        np.testing.assert_array_equal(active(truths, key, kind), active(harder, key, kind))
    # No failure follows another's dice.
    runs = [active(truths, *path) for path in (("rgb", "noise"), ("rgb", "motion_blur"), ("state", "noise"))]
    assert all((a != b).any() for a, b in zip(runs, runs[1:] + runs[:1], strict=True))


def test_a_pickled_env_goes_on_as_it_was() -> None:
    env = SensorFailure(SensorFailure(Scenes(), "event", "lag", 3), "rgb", "noise", probability=0.5)
    env.reset(seed=0)
    for _ in range(5):
        env.step(0)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(5):
        (a, *_, told), (b, *_, told_again) = env.step(0), twin.step(0)
        assert same(a, b) and told == told_again


def test_a_failure_leaves_the_dice_of_the_environment_alone() -> None:
    plain = Remembers(Scenes())
    env = SensorFailure(Scenes(), "rgb", "noise", probability=0.5)
    env.reset(seed=5)
    plain.reset(seed=5)
    for _ in range(10):
        observation, expected = env.step(0)[0], plain.step(0)[0]
        for key in ("event", "depth", "state"):
            np.testing.assert_array_equal(observation[key], expected[key])


def test_failures_are_nested_and_all_of_them_told() -> None:
    def nested(second: str, third: str) -> tuple[list[Any], list[Any]]:
        env: Env = SensorFailure(Scenes(), "rgb", second, 1, schedule=(0, 6))
        env = SensorFailure(env, "depth", "depth_dropout", 3, schedule=(2, 4))
        return rollout(SensorFailure(env, "rgb", third, 3, schedule=(4, 8)), 11)

    observations, truths = nested("black", "overexposure")
    assert all(truth.keys() == {"rgb", "depth"} and list(truth["rgb"]) == ["black", "overexposure"] for truth in truths)
    assert [truth["rgb"]["black"]["severity"] for truth in truths] == [1] * 12
    np.testing.assert_array_equal(np.flatnonzero(active(truths)), range(6))
    np.testing.assert_array_equal(np.flatnonzero(active(truths, "rgb", "overexposure")), range(4, 8))
    np.testing.assert_array_equal(np.flatnonzero(active(truths, "depth", "depth_dropout")), [2, 3])
    assert (observations[5]["rgb"][:, 14:] == 0).all()
    assert (observations[5]["rgb"] == 255).mean() > (observations[3]["rgb"] == 255).mean()

    # The inner one fails first: salt on black can be seen, black on salt cannot.
    inner_black, inner_salt = nested("black", "salt_and_pepper")[0], nested("salt_and_pepper", "black")[0]
    assert inner_black[5]["rgb"][:, 14:].any() and not inner_salt[5]["rgb"].any()


def test_two_failures_of_one_kind_need_names() -> None:
    env = SensorFailure(Scenes(), "rgb", "noise", 1, schedule=(0, 3))
    SensorFailure(env, "event", "noise")
    with pytest.raises(ValueError, match=r"'rgb'.*'noise'.*name="):
        SensorFailure(gym.wrappers.TimeLimit(env, 5), "rgb", "noise")
    truths = rollout(SensorFailure(env, "rgb", "noise", 3, schedule=(2, 5), name="later"), 5)[1]
    assert truths[2] == {
        "rgb": {
            "noise": {"kind": "noise", "severity": 1, "active": True},
            "later": {"kind": "noise", "severity": 3, "active": True},
        }
    }


def test_a_box_observation_fails_as_a_whole() -> None:
    env = SensorFailure(Scenes(image(3, 20)), None, "black", 3)
    observation, info = env.reset(seed=0)
    assert (observation == 0).all() and env.sensor == "rgb"
    assert info["sensor_failure"] == {"observation": {"black": {"kind": "black", "severity": 3, "active": True}}}
    assert SensorFailure(Scenes(image(3, 20)), None, "event_storm", sensor="event").sensor == "event"

    for kind in failures_for("vector"):
        pole = SensorFailure(gym.make("CartPole-v1"), None, kind)
        assert pole.sensor == "vector"
        observation, info = pole.reset(seed=0)
        for _ in range(4):
            assert observation.dtype == np.float32 and pole.observation_space.contains(observation)
            observation, *_ = pole.step(0)


def test_keys_tell_the_sensor() -> None:
    space = spaces.Dict(
        {"dvs_events": image(2, 20), "Depth": image(1, 20), "left": image(3, 20), "event_rate": vector(3)}
    )
    for key, sensor in {"dvs_events": "event", "Depth": "depth", "left": "rgb", "event_rate": "vector"}.items():
        assert SensorFailure(Scenes(space), key, "black").sensor == sensor
    assert SensorFailure(Scenes(space), "left", "black", sensor="depth").sensor == "depth"


def make_failing() -> Env:
    env = SensorFailure(Scenes(length=4), "rgb", "black", 3, schedule=(1, 3))
    env = SensorFailure(env, "rgb", "noise", probability=0.5)
    return SensorFailure(env, "event", "frozen", probability=0.5, per="episode")


@pytest.mark.parametrize("vector_env", [SyncVectorEnv, AsyncVectorEnv])
def test_gymnasium_vector_envs_pass_the_truth_on(
    vector_env: Callable[..., gym.vector.VectorEnv[Any, Any, Any]],
) -> None:
    envs = vector_env([make_failing] * 3)
    _, info = envs.reset(seed=1)
    coins = set()
    for step in range(9):
        truth = info["sensor_failure"]["rgb"]
        expected = step % 5 in (1, 2)  # the reset of gymnasium's vector environments takes a step of its own
        assert truth["black"]["active"].dtype == bool
        assert truth["black"]["active"].tolist() == [expected] * 3
        assert truth["black"]["severity"].tolist() == [3] * 3 and list(truth["black"]["kind"]) == ["black"] * 3
        coins.add(tuple(truth["noise"]["active"]))
        assert info["sensor_failure"]["event"]["frozen"]["active"].shape == (3,)
        observation, _, _, _, info = envs.step(np.zeros(3, int))
        assert envs.observation_space.contains(observation)
    assert len(coins) > 2
    envs.close()


@pytest.mark.parametrize("vec_env, number", [(DummyVecEnv, 2), (SubprocVecEnv, 1)])
def test_sb3_vec_envs_pass_the_truth_on_and_stack_outside(vec_env: Any, number: int) -> None:
    envs = VecFrameStack(vec_env([make_failing] * number), 2)
    envs.seed(0)
    observation: Any = envs.reset()
    assert isinstance(observation, dict) and observation["rgb"].shape == (number, 20, 20, 6)
    for step in range(1, 4):
        observation, _, _, infos = envs.step(np.zeros(number, int))
        assert [info["sensor_failure"]["rgb"]["black"]["active"] for info in infos] == [step < 3] * number
    envs.close()


def test_environment_checkers_pass() -> None:
    highway = gym.make("HighwayVision-v0", image_size=36)
    for env in (SensorFailure(highway, "event", "noise"), SensorFailure(gym.make("MountainCar-v0"), None, "lag")):
        check_env_sb3(env)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
            warnings.filterwarnings("ignore", message=".*not able to test alternative render modes")
            check_env(env, skip_render_check=True)


def test_a_spec_makes_the_wrappers_again() -> None:
    env = gym.make("HighwayVision-v0", image_size=32)
    env = SensorFailure(env, "depth", "depth_dropout", 3, probability=0.5, duration=4)
    assert env.spec is not None
    again = gym.make(env.spec)
    assert same(rollout(env, 3)[0][-1], rollout(again, 3)[0][-1])
    assert rollout(env, 8)[1] == rollout(again, 8)[1]


@pytest.mark.parametrize("modality", ["rgb", "event", "depth"])
def test_sensors_of_highway_vision_fail_alone(modality: str) -> None:
    plain = gym.make("HighwayVision-v0", image_size=32)
    for kind in failures_for(modality):
        env = SensorFailure(gym.make("HighwayVision-v0", image_size=32, weather="ClearNoon"), modality, kind, 3)
        plain = gym.make("HighwayVision-v0", image_size=32, weather="ClearNoon")
        env.reset(seed=0)
        plain.reset(seed=0)
        for _ in range(3):
            action = np.array([0.8, 0.1], np.float32)
            (failed, *_, info), (clean, *_) = env.step(action), plain.step(action)
            assert env.observation_space.contains(failed) and info["weather"] == "ClearNoon"
            for key in clean:
                assert (failed[key] == clean[key]).all() == (key != modality), (kind, key)


def test_havesac_learns_with_a_failing_sensor() -> None:
    from sb3_have import HAVESAC
    from tests.envs import RandomSensors

    space = spaces.Dict({"rgb": image(3), "event": image(5), "state": vector(4)})
    env: Env = RandomSensors(space)
    for key, kind in (("rgb", "black"), ("event", "event_storm"), ("state", "lag")):
        env = SensorFailure(env, key, kind, probability=0.5, duration=3)
    model = HAVESAC(
        "MultiInputPolicy",
        env,
        policy_kwargs=TINY,
        buffer_size=50,
        learning_starts=8,
        batch_size=8,
        seed=0,
        device="cpu",
    )
    model.learn(20)
    assert model.num_timesteps == 20 and model._n_updates > 0
    observation, _ = env.reset(seed=0)
    assert np.isfinite(model.predict(observation)[0]).all()


FLOAT_IMAGE = spaces.Box(0.0, 1.0, (20, 20, 3), np.float32)
ODD = spaces.Dict(
    {
        "float": FLOAT_IMAGE, "first": spaces.Box(0, 255, (3, 20, 20), np.uint8), "n": spaces.Discrete(3),
        "stack": spaces.Box(0, 255, (4, 20, 20, 3), np.uint8), "grey": spaces.Box(0, 255, (20, 20), np.uint8),
        "dim": spaces.Box(0, 100, (20, 20, 3), np.uint8), "ints": spaces.Box(0, 255, (6,), np.uint8), "v": vector(3),
    }
)  # fmt: skip


@pytest.mark.parametrize(
    "space, args, kwargs, message",
    [
        (SPACE, ("lidar", "black"), {}, r"\['depth', 'event', 'rgb', 'state'\].*'lidar'"),
        (SPACE, (None, "black"), {}, r"modality must be a key"),
        (image(3), ("rgb", "black"), {}, r"modality=None.*'rgb'.*DictObservation"),
        (spaces.Discrete(3), (None, "black"), {}, r"Dict or Box.*Discrete"),
        (SPACE, ("rgb", "blck"), {}, r"'blck'.*'rgb'.*black, frozen"),
        (SPACE, ("rgb", "event_storm"), {}, r"'event_storm'.*'rgb'.*motion_blur.*sensor="),
        (SPACE, ("event", "overexposure"), {}, r"'overexposure'.*'event'.*event_storm"),
        (SPACE, ("state", "misalignment"), {}, r"'misalignment'.*'vector'.*dead_pixels"),
        (SPACE, ("rgb", "black"), {"sensor": "lidar"}, r"sensor must be one of.*'lidar'"),
        (SPACE, ("rgb", "black"), {"sensor": "vector"}, r"'rgb'.*'vector'.*uint8"),
        (SPACE, ("state", "black"), {"sensor": "depth"}, r"'state'.*'depth'.*float32"),
        (ODD, ("float", "black"), {}, r"'float'.*uint8 \(H, W, C\).*float32 \(20, 20, 3\) in 0.0..1.0"),
        (ODD, ("first", "black"), {}, r"'first'.*\(3, 20, 20\).*ChannelLastImages"),
        (ODD, ("stack", "black"), {}, r"'stack'.*stack frames.*outside"),
        (ODD, ("grey", "black"), {}, r"'grey'.*\(20, 20\)"),
        (ODD, ("dim", "black"), {}, r"'dim'.*0..100"),
        (ODD, ("ints", "black"), {}, r"'ints'.*float vector.*uint8 \(6,\)"),
        (ODD, ("n", "black"), {}, r"'n' must be a Box.*Discrete"),
        (SPACE, ("rgb", "black"), {"severity": 4}, r"severity.*4"),
        (SPACE, ("rgb", "black"), {"severity": 0}, r"severity.*0"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "schedule": (0, 2)}, r"either probability or schedule"),
        (SPACE, ("rgb", "black"), {"probability": 1.5}, r"0\.\.1.*1\.5"),
        (SPACE, ("rgb", "black"), {"probability": float("nan")}, r"0\.\.1.*nan"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "per": "day"}, r"per must be.*'day'"),
        (SPACE, ("rgb", "black"), {"per": "episode"}, r"per='episode'.*without a probability"),
        (SPACE, ("rgb", "black"), {"duration": 5, "schedule": (1, 2)}, r"duration=5.*without a probability"),
        (SPACE, ("rgb", "black"), {"probability": 0.5, "per": "episode", "duration": 5}, r"duration=5.*no effect"),
        (SPACE, ("rgb", "black"), {"probability": 1.0, "duration": 5}, r"probability of 1"),
        (SPACE, ("rgb", "black"), {"probability": 0.1, "duration": 0.5}, r"1 steps or more.*0\.5"),
        (SPACE, ("rgb", "black"), {"probability": 0.8, "duration": 2}, r"0\.8.*4 steps or more.*2"),
        (SPACE, ("rgb", "black"), {"schedule": (5, 5)}, r"start < stop.*\(5, 5\)"),
        (SPACE, ("rgb", "black"), {"schedule": (-1, 5)}, r"0 <= start.*\(-1, 5\)"),
        (SPACE, ("rgb", "black"), {"schedule": (0.5, 5)}, r"steps.*0\.5"),
        (SPACE, ("rgb", "black"), {"schedule": [(0, 1, 2)]}, r"pairs.*\(0, 1, 2\)"),
        (SPACE, ("rgb", "black"), {"schedule": []}, r"start < stop.*\[\]"),
        (SPACE, ("rgb", "black"), {"schedule": 7}, r"\(start, stop\).*7"),
    ],
)
def test_bad_input_is_named(space: Any, args: tuple[Any, ...], kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SensorFailure(Scenes(space), *args, **kwargs)


def test_every_kind_was_tried() -> None:
    assert {kind for kind, _ in PAIRS} == set(FAILURES)
