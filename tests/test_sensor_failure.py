"""SensorFailure: info reports what happened, it happens when it should, and nothing else changes."""

import pickle
import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs import image, vector
from gymnasium import spaces
from scenes import SPACE, Array, Env, Remembers, Scenes, active, rollout, same

from sb3_have.sensors import FAILURES, SensorFailure, failures_for

SENSOR_OF = {"rgb": "rgb", "event": "event", "depth": "depth", "state": "vector"}
PAIRS = [(kind, key) for key, sensor in SENSOR_OF.items() for kind in failures_for(sensor)]


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


@pytest.mark.parametrize(
    "key, sensor",
    [
        ("event", "event"), ("dvs_events", "event"), ("leftEvents", "event"), ("eventFrame", "event"),
        ("EVENT_1", "event"), ("depthmap", "depth"), ("front.depth", "depth"), ("leftRGB", "rgb"), ("rgbcam", "rgb"),
        ("leftrgb", "rgb"), ("front", "rgb"), ("seventh", "rgb"), ("prevention", "rgb"),
        ("event_depth", None), ("depth_rgb", None), ("RGBDepth", None),
    ],
)  # fmt: skip
def test_a_key_that_names_several_sensors_is_refused(key: str, sensor: str | None) -> None:
    env = Scenes(spaces.Dict({key: image(3, 20)}))
    if sensor is not None:
        assert SensorFailure(env, key, "black").sensor == sensor
        return
    with pytest.raises(ValueError, match=f"{key!r} names several sensors; give sensor="):
        SensorFailure(env, key, "black")
    assert SensorFailure(env, key, "black", sensor="rgb").sensor == "rgb"


@pytest.mark.parametrize("kind", failures_for("event"))
def test_unsigned_event_images_stay_unsigned(kind: str) -> None:
    """As the representations "count", "polarity" and "time_surface" have it, no code falls below "no event"."""
    space = spaces.Dict({"event": image(6, 20)})

    class Counts(Scenes):
        def observe(self) -> Any:
            return {"event": (128 + self.np_random.poisson(1.0, (20, 20, 6))).astype(np.uint8)}

    def seen(**options: Any) -> Array:
        env = SensorFailure(Counts(space), "event", kind, 3, **options)
        return np.array([observation["event"] for observation in rollout(env, 6)[0]])

    healthy, signed, unsigned = seen(probability=0.0), seen(), seen(signed=False)
    assert healthy.min() == 128 <= unsigned.min() and (unsigned[1:] != healthy[1:]).any()
    differs = kind in ("noise", "salt_and_pepper", "event_storm")
    assert (unsigned != signed).any() == differs and (signed.min() < 128) == differs


def test_what_fails_has_nothing_to_do_with_when() -> None:
    """Were it one stream, the first pixel of every failing reset would be the draw that made it fail."""
    env = SensorFailure(Scenes(), "rgb", "salt_and_pepper", 3, probability=0.15)
    struck = []
    for seed in range(300):
        observation, info = env.reset(seed=seed)
        if info["sensor_failure"]["rgb"]["salt_and_pepper"]["active"]:
            struck.append(np.isin(observation["rgb"][0, 0], (0, 255)).all())
    assert len(struck) > 20 and 0 < np.mean(struck) < 0.6  # 30% of the pixels


class WithLock:
    """A schedule that cannot be copied."""

    def __init__(self) -> None:
        self.lock = threading.Lock()

    def __call__(self, step: int) -> bool:
        with self.lock:
            return step == 2


def test_a_schedule_is_kept_as_it_was_given() -> None:
    env = SensorFailure(Scenes(), "rgb", "black", schedule=WithLock())
    assert np.flatnonzero(active(rollout(env, 5)[1])).tolist() == [2]
    pairs: Any = [[1, 2], [4, None]]
    env = SensorFailure(Scenes(), "rgb", "black", schedule=pairs)
    pairs[0][1] = 3
    assert env._saved_kwargs["schedule"] == ((1, 2), (4, None)) == env.schedule


def test_every_kind_was_tried() -> None:
    assert {kind for kind, _ in PAIRS} == set(FAILURES)
