"""The event camera as a wrapper: equality with the camera used by hand, sub-frames, time, noise, bad input."""

import pickle
from collections.abc import Callable
from typing import Any

import cv2
import gymnasium as gym
import highway_env  # noqa: F401  registers highway-v0
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RenderCollection, RepeatAction
from moving_bar import HEIGHT, WIDTH, MovingBar, Timeless, actions, episode, frame_now, picture

from sb3_have import HAVESAC
from sb3_have.sensors import EventCamera, EventObservation, encode_events, represent, stack_by_time

Env = gym.Env[Any, Any]
LUMA = np.array((0.299, 0.587, 0.114))
QUIET: dict[str, Any] = {"threshold_sigma": 0.0}


def grey(frame: Any) -> Any:
    return frame.astype(np.float64) @ LUMA


def by_hand(camera: EventCamera, frames: list[list[Any]], dt: float, bins: int = 5) -> list[Any]:
    """Event images of steps of equally spaced frames; the first list has the frame of the reset."""
    camera.reset()
    camera.step(frames[0][0], 0.0)
    shape = frames[0][0].shape
    images = [np.full((*shape, bins), 128)]
    for i, step in enumerate(frames[1:]):
        start = i * dt
        events = np.concatenate([camera.step(f, start + dt * (k + 1) / len(step)) for k, f in enumerate(step)])
        images.append(encode_events(stack_by_time(events, bins, start, start + dt, *shape)))
    return images


def same(wanted: list[Any], observations: list[Any], key: str = "event") -> None:
    for step, (a, b) in enumerate(zip(wanted, observations, strict=True)):
        np.testing.assert_array_equal(a, b[key], err_msg=f"step {step}")


@pytest.mark.parametrize(
    "make",
    [
        lambda **kwargs: EventObservation(MovingBar("rgb_array"), **kwargs),
        lambda **kwargs: EventObservation(MovingBar("rgbd_tuple"), "render", **kwargs),
        lambda **kwargs: EventObservation(MovingBar(observation="dict"), "camera", **kwargs),
        lambda **kwargs: EventObservation(MovingBar(), frame_now, **kwargs),
        lambda **kwargs: EventObservation(RenderCollection(MovingBar("rgb_array")), **kwargs),
    ],
    ids=["rgb_array", "rgbd_tuple", "key", "function", "list"],
)
def test_the_image_is_that_of_the_camera_used_by_hand(make: Callable[..., Env]) -> None:
    options = {"threshold": (0.3, 0.25), "threshold_sigma": 0.02, "refractory": 0.03, "mapping": "log", "seed": 5}
    env = make(camera=options)
    observations = episode(env)
    assert env.observation_space["event"] == spaces.Box(0, 255, (HEIGHT, WIDTH, 5), np.uint8)  # type: ignore[index]
    assert all(env.observation_space.contains(observation) for observation in observations)
    frames = [[grey(picture(step)) / 255] for step in range(7)]
    wanted = by_hand(EventCamera(HEIGHT, WIDTH, **options), frames, 0.1)  # type: ignore[arg-type]
    same(wanted, observations)
    assert (wanted[1] > 128).any() and (wanted[1] < 128).any()
    same(wanted, episode(env))  # a second episode is the same


def test_mappings_see_the_numbers_they_are_made_for() -> None:
    for mapping, scale in (("log", 1 / 255), ("lin_log", 1.0), ("identity", 1.0)):
        options = {"mapping": mapping, "threshold": 20.0 if mapping == "identity" else 0.2}
        env = EventObservation(MovingBar("rgb_array"), camera={**options, **QUIET})
        frames = [[grey(picture(step)) * scale] for step in range(7)]
        same(by_hand(EventCamera(HEIGHT, WIDTH, **options), frames, 0.1), episode(env))  # type: ignore[arg-type]


def test_cameras_to_choose() -> None:
    def events(camera: Any) -> list[Any]:
        return [image["event"] for image in episode(EventObservation(MovingBar("rgb_array"), camera=camera))]

    frames = [[grey(picture(step))] for step in range(7)]
    mismatched = EventCamera(HEIGHT, WIDTH, threshold=0.2, threshold_sigma=0.03, mapping="lin_log", seed=0)
    np.testing.assert_array_equal(events(None), by_hand(mismatched, frames, 0.1))
    fewer = EventCamera(HEIGHT, WIDTH, threshold=0.5, threshold_sigma=0.03, mapping="lin_log", seed=0)
    np.testing.assert_array_equal(events({"threshold": 0.5}), by_hand(fewer, frames, 0.1))
    carla = [[frame[0] / 255] for frame in frames]
    np.testing.assert_array_equal(events("carla"), by_hand(EventCamera.preset("carla", HEIGHT, WIDTH), carla, 0.1))
    for camera in ({"preset": "carla", "threshold": 0.5}, EventCamera.preset("carla", HEIGHT, WIDTH, threshold=0.5)):
        wanted = by_hand(EventCamera.preset("carla", HEIGHT, WIDTH, threshold=0.5), carla, 0.1)
        np.testing.assert_array_equal(events(camera), wanted)


def test_a_camera_that_is_given_is_copied() -> None:
    camera = EventCamera(HEIGHT, WIDTH, mapping="lin_log")
    env = EventObservation(MovingBar("rgb_array"), camera=camera)
    episode(env)
    assert len(camera.step(grey(picture(0)), 0.0)) == 0  # still its first frame


@pytest.mark.parametrize(
    "representation, tau, channels",
    [
        ("sbt", None, 3),
        ("voxel", None, 3),
        ("count", None, 3),
        ("polarity", None, 6),
        ("time_surface", None, 2),
        ("time_surface", 0.02, 2),
    ],
)
def test_representations(representation: Any, tau: float | None, channels: int) -> None:
    camera = EventCamera(HEIGHT, WIDTH, mapping="lin_log")
    camera.detect(grey(picture(0)), 0.0)
    values = represent(*camera.detect(grey(picture(1)), 0.1), 3, 0.0, 0.1, HEIGHT, WIDTH, representation, tau)
    env = EventObservation(MovingBar("rgb_array"), bins=3, representation=representation, tau=tau, camera=QUIET)
    first, second = episode(env, 1)
    assert env.observation_space.contains(first) and env.observation_space.contains(second)
    assert second["event"].shape == (HEIGHT, WIDTH, channels)
    np.testing.assert_array_equal(second["event"], encode_events(values, representation))


@pytest.mark.parametrize("image_size, size", [(12, (12, 12)), ((18, 20), (18, 20))])
def test_image_size_is_the_cameras(image_size: Any, size: tuple[int, int]) -> None:
    for env in (
        EventObservation(MovingBar("rgb_array"), image_size=image_size, camera=QUIET),
        EventObservation(MovingBar(observation="dict"), "camera", image_size=image_size, camera=QUIET),
        EventObservation(MovingBar(), lambda env: grey(frame_now(env)), image_size=image_size, camera=QUIET),
    ):
        frames = [
            [cv2.resize(grey(picture(step)), size[::-1], interpolation=cv2.INTER_AREA)] for step in range(7)
        ]  # grey first: no rounding to 8 bits before the camera
        same(by_hand(EventCamera(*size, mapping="lin_log"), frames, 0.1), episode(env))


def test_grey_images_of_either_shape() -> None:
    frames = [[picture(step)[..., 1].astype(float)] for step in range(7)]
    wanted = by_hand(EventCamera(HEIGHT, WIDTH, mapping="lin_log"), frames, 0.1)
    same(wanted, episode(EventObservation(MovingBar(observation="dict"), "grey", camera=QUIET)))
    one = EventObservation(MovingBar(), lambda env: frame_now(env)[..., 1:2], camera=QUIET)
    same(wanted, episode(one))


def test_several_frames_a_step() -> None:
    def film(env: Env) -> list[Any]:
        """Four frames a step, as intensities that the camera takes as they are."""
        now = env.unwrapped.steps  # type: ignore[attr-defined]
        return [brightness(now - 0.75), brightness(now - 0.5), brightness(now - 0.25), brightness(now)]

    def brightness(time: float) -> Any:
        return np.full((4, 6), np.exp(np.sin(3 * time)))

    options = {"mapping": "log", "threshold": 0.3, "log_eps": 1e-9}
    env = EventObservation(MovingBar(), film, camera={**options, **QUIET}, dt=2.0, bins=4)
    frames = [[brightness(0)], *([brightness(k + j / 4) for j in (1, 2, 3, 4)] for k in range(6))]
    wanted = by_hand(EventCamera(4, 6, **options), frames, 2.0, 4)  # type: ignore[arg-type]
    same(wanted, episode(env))
    assert any((image.max(axis=-1) > 128).any() and (image.min(axis=-1) < 128).any() for image in wanted)


def test_action_repeat_over_collected_frames() -> None:
    """Any environment offers sub-frames this way; a list lasts as long as its frames, the last one may be short."""
    env = EventObservation(
        RepeatAction(RenderCollection(MovingBar("rgb_array")), 5), camera=QUIET, key="sparks", representation="voxel"
    )
    observations = episode(env, 3)  # 5 + 5 + 2 steps of 0.1 s
    camera = EventCamera(HEIGHT, WIDTH, mapping="lin_log")
    camera.detect(grey(picture(0)), 0.0)
    for i, (first, last) in enumerate([(1, 5), (6, 10), (11, 12)]):
        parts = [camera.detect(grey(picture(k)), k * 0.1) for k in range(first, last + 1)]
        pixel, time, polarity = (np.concatenate(part) for part in zip(*parts, strict=True))
        window = ((first - 1) * 0.1 - 1e-9, last * 0.1 + 1e-9)
        voxels = represent(pixel, time, polarity, 5, *window, HEIGHT, WIDTH, "voxel")
        # Halves may be rounded either way.
        difference = np.abs(observations[i + 1]["sparks"].astype(float) - 128 - voxels)
        assert difference.max() < 0.5 + 1e-6
    assert env.time == pytest.approx(1.2)
    with pytest.raises(ValueError, match="no frame"):
        env.sense({}, start=False)


@pytest.mark.parametrize("env_id, dt", [("CartPole-v1", 0.02), ("Pendulum-v1", 0.05), ("highway-v0", 1.0)])
def test_known_environments(env_id: str, dt: float) -> None:
    env = EventObservation(gym.make(env_id, render_mode="rgb_array"), image_size=(32, 48))
    space = env.observation_space
    assert isinstance(space, spaces.Dict) and list(space) == ["event", "state"]
    observations = [env.reset(seed=0)[0]]
    env.action_space.seed(0)
    while len(observations) < 6:
        observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
        observations.append(env.reset()[0] if terminated or truncated else observation)
    assert all(space.contains(observation) for observation in observations)
    assert (observations[0]["event"] == 128).all()
    assert any((observation["event"] != 128).any() for observation in observations)
    env.reset()
    env.step(env.action_space.sample())
    assert env.time == pytest.approx(dt)
    env.close()


class Recorder:
    """What highway-env takes for gymnasium's ``RecordVideo``: keeps the frames of every step."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.frames_per_sec = 0
        self.frames: list[list[Any]] = []

    def _capture_frame(self) -> None:
        self.frames[-1].append(grey(self.env.render()))


def top_view() -> Any:
    config = {"simulation_frequency": 6, "vehicles_count": 8, "screen_width": 200, "screen_height": 60}
    return gym.make("highway-v0", render_mode="rgb_array", config=config)


def recorded(env: Any) -> tuple[list[Any], list[list[Any]]]:
    """Observations and frames of a reset and three steps."""
    observations = [env.reset(seed=1)[0]]
    recorder = Recorder(env)
    env.unwrapped.set_record_video_wrapper(recorder)
    recorder.frames.append([grey(env.render())])
    for _ in range(3):
        recorder.frames.append([])
        observations.append(env.step(1)[0])
        recorder._capture_frame()
    assert env.unwrapped._record_video_wrapper is recorder
    env.close()
    return observations, recorder.frames


def test_highway_env_gives_a_frame_for_every_simulation_step() -> None:
    frames = recorded(top_view())[1]
    assert [len(step) for step in frames] == [1, 6, 6, 6]
    observations, seen = recorded(EventObservation(top_view(), camera=QUIET))
    # A recording outside of the wrapper has its frames all the same.
    for step, same_step in zip(frames, seen, strict=True):
        np.testing.assert_array_equal(step, same_step)
    camera = EventCamera(60, 200, mapping="lin_log")
    same(by_hand(camera, frames, 1.0), observations)
    coarse = by_hand(camera, [step[-1:] for step in frames], 1.0)
    assert any((a != b["event"]).any() for a, b in zip(coarse, observations, strict=True))


# ------------------------------------------------------------------------------------------------------- noise, seeds


def test_same_seed_same_noise() -> None:
    def noise(env: Env, seed: int | None) -> Any:
        return np.stack([observation["event"] for observation in episode(env, seed=seed)])

    def make(key: str = "event") -> Env:
        return EventObservation(MovingBar("rgb_array"), camera={"shot_rate": 50.0}, key=key)

    env = make()
    first = noise(env, 7)
    np.testing.assert_array_equal(first, noise(env, 7))
    np.testing.assert_array_equal(first, noise(make(), 7))
    assert (first != noise(env, 8)).any()
    after = noise(env, None)  # an episode without a seed goes on with the generator
    assert (after != noise(env, 8)).any()
    noise(env, 8)
    np.testing.assert_array_equal(after, noise(env, None))
    other = np.stack([observation["eye"] for observation in episode(make("eye"), seed=7)])
    assert (first != other).any()
    assert (noise(make(), None) != noise(make(), None)).any()
    assert (first[0] == 128).all()
    first, again = (noise(EventObservation(MovingBar("rgb_array"), camera="noisy"), 7) for _ in range(2))
    np.testing.assert_array_equal(first, again)  # its pixels are the same chip's too


def test_the_sensor_leaves_the_environment_alone() -> None:
    plain = gym.make("Pendulum-v1")
    env = EventObservation(gym.make("Pendulum-v1", render_mode="rgb_array"), image_size=16, camera="noisy")
    for seed in (0, None):
        states = [plain.reset(seed=seed)[0], *(plain.step(np.ones(1, np.float32))[0] for _ in range(5))]
        seen = [env.reset(seed=seed)[0], *(env.step(np.ones(1, np.float32))[0] for _ in range(5))]
        np.testing.assert_array_equal(states, [observation["state"] for observation in seen])
    env.close()


def test_pickled_in_the_middle_of_an_episode() -> None:
    env = EventObservation(MovingBar("rgb_array"), camera={"shot_rate": 50.0})
    episode(env, 3)
    copy = pickle.loads(pickle.dumps(env))
    for action in actions(5):
        np.testing.assert_array_equal(env.step(action)[0]["event"], copy.step(action)[0]["event"])


def test_havesac_trains_on_pendulum_seen_by_an_event_camera() -> None:
    env = EventObservation(gym.make("Pendulum-v1", render_mode="rgb_array"), image_size=36, bins=2)
    tiny = {"features_dim": 8, "net_arch": [16], "precision": "float32"}
    model = HAVESAC(
        "MultiInputPolicy", env, learning_starts=8, batch_size=8, buffer_size=100, policy_kwargs=tiny, device="cpu"
    )
    model.learn(30)
    assert model._n_updates == 22
    assert set(model.modality_weights(model.env.reset())) == {"event", "state"}  # type: ignore[union-attr,arg-type]
    env.close()


# ---------------------------------------------------------------------------------------------------------- bad input


def bar(**kwargs: Any) -> Env:
    return EventObservation(MovingBar("rgb_array", "dict"), **kwargs)


@pytest.mark.parametrize(
    "make, error, message",
    [
        (lambda: EventObservation(MovingBar()), ValueError, "got None; pass render_mode='rgb_array' to gym.make"),
        (lambda: EventObservation(MovingBar("human")), ValueError, "'human'; pass render_mode='rgb_array'"),
        (lambda: bar(source="rgb"), KeyError, r"no key 'rgb', only \['camera', 'grey'"),
        (lambda: bar(source="position"), ValueError, r"'position' must be a uint8 image.*got Box.*TransformObs"),
        (lambda: bar(source="lidar"), ValueError, "'lidar' must be a uint8 image"),
        (
            lambda: EventObservation(MovingBar(observation=spaces.Box(0, 255, (3, 8, 8), np.uint8)), "state"),
            ValueError,
            "convert it first with ChannelLastImages",
        ),
        (lambda: bar(key="grey"), ValueError, "already has the key 'grey'"),
        (lambda: bar(camera={"treshold": 0.3}), TypeError, "treshold"),
        (lambda: bar(camera={"threshold": -1}), ValueError, "threshold must be"),
        (lambda: bar(camera="davis"), ValueError, "ideal.*got 'davis'"),
        (lambda: bar(camera=EventCamera(4, 6)), ValueError, r"4 x 6 pixels, the image 36 x 40; pass image_size=\(4, 6"),
        (lambda: bar(representation="image"), ValueError, "voxel"),
        (lambda: bar(bins=0), ValueError, "bins"),
        (lambda: bar(bins=2.5), ValueError, "bins must be a whole number >= 1, got 2.5"),
        (lambda: bar(bins=True), ValueError, "bins must be a whole number >= 1, got True"),
        (lambda: bar(tau=-1.0, representation="time_surface"), ValueError, "tau"),
        (lambda: bar(image_size=-3), ValueError, "image_size"),
        (lambda: bar(dt=0.0), ValueError, "dt must be.*got 0.0"),
        (lambda: bar(dt=np.nan), ValueError, "dt must be.*nan"),
        (lambda: EventObservation(Timeless("rgb_array")), ValueError, r"render_fps.*pass dt=<seconds>"),
        (lambda: bar(source=lambda env: None), ValueError, "must return a frame or a list of frames, got None"),
        (lambda: bar(source=lambda env: []), ValueError, r"list of frames, got \[\]"),
        (lambda: bar(source=lambda env: [1.5]), ValueError, "a frame must be uint8.*got float"),
        (lambda: bar(dt="0.1"), ValueError, "dt must be.*got '0.1'"),
    ],
)
def test_bad_options(make: Callable[[], Env], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    "frame, message",
    [
        (np.zeros((3, 8, 8), np.uint8), r"got uint8 \(3, 8, 8\)"),
        (np.zeros((8, 8), np.int32), r"got int32 \(8, 8\)"),
        (np.zeros((8, 8, 3)), r"got float64 \(8, 8, 3\)"),
        (np.full((8, 8), -1.0), "frame must be >= 0"),
        (np.full((8, 8), np.inf), "NaN or infinite"),
    ],
)
def test_bad_frames(frame: Any, message: str) -> None:
    env = EventObservation(MovingBar(), lambda env: frame, image_size=8)
    with pytest.raises(ValueError, match=message):
        env.reset()


def test_time_that_the_environment_does_not_know_may_be_told() -> None:
    env = EventObservation(Timeless("rgb_array"), dt=0.5)
    episode(env, 2)
    assert env.time == 1.0
