"""Any environment into a Dict of images: rendered frames, selections, channel order; and what all wrappers share."""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import AddRenderObservation, FilterObservation, RenderCollection, RepeatAction
from moving_bar import HEIGHT, WIDTH, MovingBar, episode, frame_now, picture
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_have.sensors import (
    ChannelLastImages,
    DepthObservation,
    DictObservation,
    EventObservation,
    RenderObservation,
)

Env = gym.Env[Any, Any]

# The wrapped environment is checked on purpose; Gymnasium prefers the bare one
bare = pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")

# Python 3.12 and later.
pytestmark = pytest.mark.filterwarnings("ignore:.*is multi-threaded, use of fork:DeprecationWarning")


def bar_camera() -> Env:
    """Colour, events and depth of one rendering."""
    env = gym.make("MovingBar-v0", render_mode="rgbd_tuple")
    camera = {"shot_rate": 20.0}
    return DepthObservation(EventObservation(RenderObservation(env), camera=camera), noise="redwood", dropout=0.1)


def bar_keys() -> Env:
    """The same from an observation that has them."""
    env = gym.make("MovingBar-v0", observation="dict")
    env = EventObservation(env, source="camera", image_size=(40, 36))
    return FilterObservation(DepthObservation(env, source="lidar"), ["camera", "event", "depth"])


def bar_state() -> Env:
    return DictObservation(gym.make("MovingBar-v0"), key="position")


def bar_images() -> Env:
    env = FilterObservation(gym.make("MovingBar-v0", observation="dict"), ["camera", "grey"])
    return ChannelLastImages(env, ["camera", "grey"])


ENVS: list[Callable[[], Env]] = [bar_camera, bar_keys, bar_state, bar_images]
every_wrapper = pytest.mark.parametrize("make", ENVS, ids=lambda make: make.__name__)


@bare
@every_wrapper
def test_checkers(make: Callable[[], Env]) -> None:
    # Not the other render modes: "human" is what the wrappers refuse.
    gymnasium_check_env(make(), skip_render_check=True)
    sb3_check_env(make())


@every_wrapper
def test_the_spec_makes_the_same_environment(make: Callable[[], Env]) -> None:
    env = make()
    assert env.spec is not None
    same_episodes(episode(env), episode(gym.make(env.spec)))


def same_episodes(first: list[Any], second: list[Any]) -> None:
    for a, b in zip(first, second, strict=True):
        assert a.keys() == b.keys()
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])


@pytest.mark.parametrize("vectorize", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
@pytest.mark.parametrize("make", [bar_camera, bar_keys], ids=lambda make: make.__name__)
def test_gymnasium_vector_envs(vectorize: Any, make: Callable[[], Env]) -> None:
    alone = [episode(make(), seed=seed) for seed in (3, 4)]
    env = vectorize([make, make])
    observations = [env.reset(seed=3)[0]]
    observations += [env.step(np.zeros((2, 2), np.float32))[0] for _ in range(6)]
    env.close()
    for i in range(2):
        same_episodes(alone[i], [{key: image[i] for key, image in seen.items()} for seen in observations])


@pytest.mark.parametrize("vectorize", [DummyVecEnv, partial(SubprocVecEnv, start_method="fork")])
@pytest.mark.parametrize("make", [bar_camera, bar_keys], ids=lambda make: make.__name__)
def test_sb3_vector_envs(vectorize: Callable[..., VecEnv], make: Callable[[], Env]) -> None:
    alone = [episode(make(), seed=seed) for seed in (3, 4)]
    env = vectorize([make, make])
    env.seed(3)
    observations: list[Any] = [env.reset()]
    observations += [env.step(np.zeros((2, 2), np.float32))[0] for _ in range(6)]
    env.close()
    for i in range(2):
        same_episodes(alone[i], [{key: image[i] for key, image in seen.items()} for seen in observations])


def test_a_function_travels_to_a_subprocess() -> None:
    env = SubprocVecEnv([lambda: EventObservation(MovingBar(), source=lambda env: frame_now(env))], start_method="fork")
    seen = env.reset()
    assert isinstance(seen, dict) and (seen["event"] == 128).all()
    after = env.step(np.zeros((1, 2)))[0]
    env.close()
    assert isinstance(after, dict) and (after["event"] != 128).any()


def test_sb3_trains_on_it() -> None:
    env = EventObservation(RenderObservation(MovingBar("rgb_array"), image_size=36), image_size=36)
    model = SAC(
        "MultiInputPolicy", env, learning_starts=8, buffer_size=50, batch_size=4, policy_kwargs={"net_arch": [8]}
    )
    model.learn(20)
    assert model._n_updates == 12


# ------------------------------------------------------------------------------------------------ one rendering a step


def test_all_sensors_share_one_rendering() -> None:
    for order in ((RenderObservation, EventObservation, DepthObservation), (DepthObservation, EventObservation)):
        base = MovingBar("rgbd_tuple")
        env: Env = base
        for wrapper in order:
            env = wrapper(env, image_size=16)
        before = base.renderings
        assert before == 0  # with a known size there is no need to try
        env.reset(seed=0)
        assert base.renderings == 1
        for step in range(1, 6):
            env.step(np.zeros(2))
            assert base.renderings == 1 + step
            shown: Any = env.render()
            np.testing.assert_array_equal(shown[0], picture(step))
        assert base.renderings == 6


def test_render_shows_the_present() -> None:
    env = RenderObservation(MovingBar("rgb_array"))
    first = env.reset()[0]["rgb"]
    shown = env.render()
    shown[:] = 0  # a rendering may be modified without changing the observation or the next rendering
    assert (first == picture(0)).all()
    np.testing.assert_array_equal(env.render(), picture(0))
    env.step(np.zeros(2))
    np.testing.assert_array_equal(env.render(), picture(1))
    env.reset()
    np.testing.assert_array_equal(env.render(), picture(0))


def test_a_list_of_frames_is_still_there_for_the_next_wrapper() -> None:
    env = RenderObservation(EventObservation(MovingBar("rgb_array_list"), image_size=16), image_size=16)
    for observation in episode(env):
        assert observation["rgb"].shape == (16, 16, 3)
    assert len(env.render()) == 1


# ----------------------------------------------------------------------------------------------------- each of the four


def test_render_observation() -> None:
    env = RenderObservation(MovingBar("rgb_array", "dict"), key="view")
    for step, observation in enumerate(episode(env)):
        assert list(observation) == ["position", "camera", "grey", "lidar", "view"]
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(observation["view"], picture(step))
    for image_size, size in ((8, (8, 8)), ((12, 16), (12, 16)), ((48, 40), (48, 40))):
        small = RenderObservation(MovingBar("rgb_array"), image_size=image_size)
        observation = episode(small, 2)[-1]
        assert observation["rgb"].shape == (*size, 3) and list(observation) == ["state", "rgb"]
        wanted = cv2.resize(picture(2), size[::-1], interpolation=cv2.INTER_AREA)
        np.testing.assert_array_equal(observation["rgb"], wanted)
    collected = RenderObservation(RenderCollection(MovingBar("rgb_array")))
    np.testing.assert_array_equal(episode(collected, 3)[-1]["rgb"], picture(3))
    repeated = RenderObservation(RepeatAction(RenderCollection(MovingBar("rgb_array")), 2))
    np.testing.assert_array_equal(episode(repeated, 3)[-1]["rgb"], picture(6))


def test_dict_observation() -> None:
    env = DictObservation(MovingBar(), key="position")
    assert env.observation_space == spaces.Dict({"position": MovingBar().observation_space})
    np.testing.assert_array_equal(episode(env)[4]["position"], (4, 4))


def test_gymnasiums_wrapper_shares_the_rendering() -> None:
    """Outside of a sensor, AddRenderObservation gets the rendering that the sensor has looked at."""
    base = MovingBar("rgb_array")
    env = AddRenderObservation(EventObservation(base, image_size=16), render_only=False, render_key="rgb")
    env.reset(seed=0)
    before = base.renderings
    observation = env.step(np.zeros(2))[0]
    assert base.renderings == before + 1
    np.testing.assert_array_equal(observation["rgb"], picture(1))


class Images(MovingBar):
    """Observations of any space, given."""

    def __init__(self, space: spaces.Space[Any], observation: Any) -> None:
        super().__init__()
        self.observation_space, self.seen = space, observation

    def observe(self) -> Any:
        return self.seen


def test_channel_last_images() -> None:
    rng = np.random.default_rng(0)
    shapes = {"first": (3, 8, 9), "last": (8, 9, 3), "one": (1, 8, 9), "grey": (8, 9), "cube": (4, 4, 4)}
    inner: dict[str, Any] = {key: spaces.Box(0, 255, shape, np.uint8) for key, shape in shapes.items()}
    inner |= {
        "unit": spaces.Box(0.0, 1.0, (3, 8, 9), np.float32),
        "bytes": spaces.Box(0.0, 255.0, (8, 9, 1), np.float64),
        "metres": spaces.Box(0.0, 50.0, (8, 9, 1), np.float32),
        "vector": spaces.Box(0.0, 1.0, (3,), np.float32),
    }
    seen: dict[str, Any] = {key: rng.integers(0, 256, shape, np.uint8) for key, shape in shapes.items()}
    seen |= {
        "unit": rng.random((3, 8, 9), np.float32),
        "bytes": rng.random((8, 9, 1)) * 255,
        "metres": rng.random((8, 9, 1), np.float32),
        "vector": rng.random(3, np.float32),
    }
    env = ChannelLastImages(Images(spaces.Dict(inner), seen))
    assert set(env.keys) == {"first", "last", "one", "cube", "unit", "bytes"}
    out = env.reset()[0]
    assert env.observation_space.contains(out)
    np.testing.assert_array_equal(out["first"], seen["first"].transpose(1, 2, 0))
    np.testing.assert_array_equal(out["one"], seen["one"][0][..., None])
    np.testing.assert_array_equal(out["unit"], np.rint(255 * seen["unit"].transpose(1, 2, 0)))
    np.testing.assert_array_equal(out["bytes"], np.rint(seen["bytes"]))
    for key in ("last", "grey", "cube", "metres", "vector"):
        assert out[key].dtype == seen[key].dtype
        np.testing.assert_array_equal(out[key], seen[key])
    assert all(out[key].flags.c_contiguous for key in env.keys)

    named = ChannelLastImages(Images(spaces.Dict(inner), seen), ["grey"])
    np.testing.assert_array_equal(named.reset()[0]["grey"], seen["grey"][..., None])
    np.testing.assert_array_equal(named.reset()[0]["first"], seen["first"])

    alone = ChannelLastImages(Images(inner["grey"], seen["grey"]), ["state"])
    np.testing.assert_array_equal(alone.reset()[0], seen["grey"][..., None])
    alone = ChannelLastImages(Images(inner["unit"], seen["unit"]))
    assert alone.observation_space == spaces.Box(0, 255, (8, 9, 3), np.uint8)
    np.testing.assert_array_equal(alone.reset()[0], out["unit"])


# ---------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "make, error, message",
    [
        (lambda: RenderObservation(MovingBar()), ValueError, "got None; pass render_mode='rgb_array' to gym.make"),
        (lambda: RenderObservation(MovingBar("human")), ValueError, "'human'; pass render_mode='rgb_array'"),
        (
            lambda: RenderObservation(MovingBar("depth_array")),
            ValueError,
            "'depth_array'; pass render_mode='rgb_array'",
        ),
        (lambda: RenderObservation(TextEnv()), ValueError, r"only offers \['ansi'\]"),
        (
            lambda: RenderObservation(MovingBar("rgb_array", "dict"), "grey"),
            ValueError,
            r"already has the key 'grey'.*lidar",
        ),
        (lambda: RenderObservation(MovingBar("rgb_array"), "state"), ValueError, "already has the key 'state'"),
        (lambda: RenderObservation(MovingBar("rgb_array"), image_size=0), ValueError, "image_size.*got 0"),
        (lambda: RenderObservation(MovingBar("rgb_array"), image_size=8.5), ValueError, "image_size.*8.5"),  # type: ignore[arg-type]
        (lambda: RenderObservation(MovingBar("rgb_array"), image_size=(8, 8, 3)), ValueError, r"\(8, 8, 3\)"),  # type: ignore[arg-type]
        (lambda: RenderObservation(MovingBar("rgb_array"), image_size=True), ValueError, "image_size.*True"),
        (lambda: DictObservation(MovingBar(observation="dict")), ValueError, "already a Dict.*lidar"),
        (lambda: ChannelLastImages(MovingBar()), ValueError, r"Box.*three-dimensional image.*keys=\["),
        (lambda: ChannelLastImages(MovingBar(observation="dict"), ["rgb"]), KeyError, "no key 'rgb', only.*lidar"),
        (lambda: ChannelLastImages(MovingBar(observation="dict"), "grey"), ValueError, "list of keys, got 'grey'"),
        (
            lambda: ChannelLastImages(MovingBar(observation="dict"), ["lidar"]),
            ValueError,
            "'lidar'.*bounds must be 0..1",
        ),
        (lambda: ChannelLastImages(MovingBar(observation="dict"), ["position"]), ValueError, r"'position'.*\(H, W\)"),
        (
            lambda: ChannelLastImages(MovingBar(observation=spaces.Box(0, 255, (9, 3, 8), np.uint8)), ["state"]),
            ValueError,
            "second size is the smallest",
        ),
    ],
)
def test_bad_options(make: Callable[[], Env], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()


class TextEnv(MovingBar):
    metadata = {"render_modes": ["ansi"], "render_fps": 1}  # noqa: RUF012


@pytest.mark.parametrize(
    "image, message",
    [
        (np.full((4, 4, 1), 1.5, np.float32), r"'state' has bounds 0..1 but holds .*1.5.*clip it"),
        (np.full((4, 4, 1), -0.1, np.float32), "-0.1"),
        (np.full((4, 4, 1), np.nan, np.float32), "nan"),
        (np.zeros((4, 5, 1), np.float32), r"must be float32 \(4, 4, 1\) like its space, got float32 \(4, 5, 1\)"),
    ],
)
def test_float_images_out_of_range(image: Any, message: str) -> None:
    env = ChannelLastImages(Images(spaces.Box(0.0, 1.0, (4, 4, 1), np.float32), image))
    with pytest.raises(ValueError, match=message):
        env.reset()


@pytest.mark.parametrize(
    "image, message",
    [
        (np.full((3, 8, 8), 0.7), r"must be uint8 \(3, 8, 8\) like its space, got float64 \(3, 8, 8\)"),
        (np.full((3, 8, 8), 300), r"got int64 \(3, 8, 8\)"),
        ([[[0]]], "got list"),
    ],
)
def test_images_of_another_number(image: Any, message: str) -> None:
    env = ChannelLastImages(Images(spaces.Box(0, 255, (3, 8, 8), np.uint8), image))
    with pytest.raises(ValueError, match=message):
        env.reset()


def test_masks_and_whole_numbers_are_scaled_too() -> None:
    mask = np.eye(8, dtype=np.uint8)[None]
    env = ChannelLastImages(Images(spaces.Box(0, 1, (1, 8, 8), np.uint8), mask))
    np.testing.assert_array_equal(env.reset()[0][..., 0], 255 * mask[0])
    whole = np.arange(192, dtype=np.int32).reshape(3, 8, 8)
    env = ChannelLastImages(Images(spaces.Box(0, 255, (3, 8, 8), np.int32), whole))
    np.testing.assert_array_equal(env.reset()[0], whole.transpose(1, 2, 0))
    env = ChannelLastImages(Images(spaces.Box(0, 255, (3, 8, 8), np.int32), whole + 200))
    with pytest.raises(ValueError, match=r"bounds 0..255 but holds .*200.* to .*391"):
        env.reset()


class BadRenderer(MovingBar):
    def __init__(self, mode: str, rendering: Any) -> None:
        super().__init__(mode)
        self.rendering = rendering

    def render(self) -> Any:
        return self.rendering


@pytest.mark.parametrize(
    "mode, rendering, message",
    [
        ("rgb_array", None, r"uint8 \(H, W, 3\), got NoneType"),
        ("rgb_array", np.zeros((4, 4), np.uint8), r"got uint8 \(4, 4\)"),
        ("rgb_array", np.zeros((4, 4, 3)), r"got float64 \(4, 4, 3\)"),
        ("rgb_array_list", [], "no frame.*called elsewhere"),
        ("rgbd_tuple", (picture(0), picture(0)), r"float depth \(H, W\), got uint8"),
    ],
)
def test_bad_renderings(mode: str, rendering: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RenderObservation(BadRenderer(mode, rendering))
    with pytest.raises(ValueError, match=message):
        RenderObservation(BadRenderer(mode, rendering), image_size=8).reset()


def test_sizes_of_the_test_environment() -> None:
    assert picture(0).shape == (HEIGHT, WIDTH, 3)
