"""What sensors look at: the scale of its numbers, its size, its time, and who else may touch it."""

import warnings
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  registers highway-v0
import numpy as np
import pytest
from gymnasium import spaces
from moving_bar import MovingBar, episode, frame_now, picture

import sb3_have  # noqa: F401  registers HighwayVision-v0
from sb3_have.sensors import PRESETS, DepthObservation, EventObservation, RenderObservation
from sb3_have.sensors.rendering import step_duration

Env = gym.Env[Any, Any]


def flashing(scale: float, camera: Any = None) -> Env:
    """Black and white in turns, white being this number."""

    def flash(env: Any) -> Any:
        return np.full((8, 8), scale * (env.unwrapped.steps % 2))

    return EventObservation(MovingBar(), flash, camera=camera, image_size=8)


def fires(env: Env) -> bool:
    return any((observation["event"] != 128).any() for observation in episode(env))


@pytest.mark.parametrize("camera", [None, "noisy"])
def test_frames_in_0_to_1_where_0_to_255_is_expected(camera: Any) -> None:
    env = flashing(1.0, camera)
    with warnings.catch_warnings():  # the scale of a black frame is unknown
        warnings.simplefilter("error")
        env.reset(seed=0)
    with pytest.warns(UserWarning, match="float frames only reach 1, .*'lin_log' expects 0..255.*camera='ideal'"):
        env.step(np.zeros(2))
    with warnings.catch_warnings():  # once
        warnings.simplefilter("error")
        env.step(np.zeros(2))
        env.step(np.zeros(2))


@pytest.mark.parametrize("scale, camera", [(255.0, None), (1.0, "ideal"), (1.0, "carla"), (1.0, {"mapping": "log"})])
def test_frames_of_the_expected_scale(scale: float, camera: Any) -> None:
    assert fires(flashing(scale, camera))


def key(space: spaces.Box) -> Env:
    return EventObservation(MovingBar(observation=space), "state")


@pytest.mark.parametrize(
    "space, remedy",
    [
        (spaces.Box(0, 1, (8, 8, 3), np.uint8), "ChannelLastImages"),
        (spaces.Box(10, 255, (8, 8, 3), np.uint8), "TransformObservation"),
        (spaces.Box(0.0, 1.0, (3, 8, 8), np.float32), "ChannelLastImages"),
        (spaces.Box(0, 255, (8, 8), np.int32), "ChannelLastImages"),
        (spaces.Box(0, 255, (8, 8, 4), np.uint8), "TransformObservation"),
        (spaces.Box(0.0, 1.0, (4,), np.float32), "TransformObservation"),
    ],
    ids=str,
)
def test_keys_that_are_no_frames(space: spaces.Box, remedy: str) -> None:
    with pytest.raises(ValueError, match=rf"'state' must be a uint8 image.* in 0..255, got Box.*{remedy}"):
        key(space)


@pytest.mark.parametrize("wrapper", [RenderObservation, EventObservation])
@pytest.mark.parametrize("image_size", [None, 16])
def test_highway_env_that_is_told_to_draw_nothing(
    wrapper: Any, image_size: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with pytest.raises(ValueError, match=r"only black frames with SDL_VIDEODRIVER=dummy; unset it.*'offscreen'"):
        wrapper(gym.make("highway-v0", render_mode="rgb_array"), image_size=image_size).reset()
    # It does not use highway-env's drawing.
    vision = gym.make("HighwayVision-v0", render_mode="rgb_array", vehicles_count=2)
    assert wrapper(vision, image_size=image_size, key="view").reset(seed=0)[0]["view"].any()
    vision.close()
    other: Any = MovingBar("rgb_array")
    other.viewer = SimpleNamespace(enabled=False)
    assert wrapper(other, image_size=image_size, key="view").reset()[0]["view"].any()


@pytest.mark.parametrize("dt", [0.5, np.float32(0.5), np.float64(0.5)], ids=repr)
def test_step_durations_of_any_number(dt: Any) -> None:
    env: Any = MovingBar()
    assert step_duration(env) == 0.1
    env.dt = dt
    assert step_duration(env) == 0.5


@pytest.mark.parametrize("broken, time", [(3, 0.1), (4, 0.15)])
def test_time_stands_still_when_a_frame_is_refused(broken: int, time: float) -> None:
    """The camera refuses it, and the next step begins where the last accepted frame was."""
    frames = [np.full((4, 4), value) for value in (10.0, 20.0, 40.0, 80.0, 160.0)]

    def film(env: Any) -> list[Any]:
        step = 2 * env.unwrapped.steps
        return [np.full((4, 4), np.nan) if k == broken else frames[k] for k in (step - 1, step)]

    env = EventObservation(MovingBar(), film, image_size=4, bins=2)
    env.reset(seed=0)
    env.step(np.zeros(2))
    assert env.time == env.camera._time == pytest.approx(0.1)
    with pytest.raises(ValueError, match="NaN"):
        env.step(np.zeros(2))
    assert env.time == env.camera._time == pytest.approx(time)


def test_a_rendering_in_several_parts_is_handed_out_as_a_copy() -> None:
    inner = RenderObservation(MovingBar("rgbd_tuple"))
    env = DepthObservation(inner)
    env.reset()
    shown: Any = env.render()
    shown[0][:] = 0
    shown[1][:] = 0
    for again in (env.render(), inner.render()):
        np.testing.assert_array_equal(again[0], picture(0))
        assert again[1].max() > 0


def test_arguments_that_are_changed_later() -> None:
    camera: dict[str, Any] = {"threshold": [0.3, 0.3]}
    noise = {"lateral_sigma": 0.0}
    env: Env = gym.make("MovingBar-v0", render_mode="rgbd_tuple")
    env = DepthObservation(EventObservation(env, camera=camera), noise=noise)
    before = episode(env)
    camera["threshold"][0] = -5.0
    camera["treshold"] = noise["sigma"] = 1.0
    assert env.spec is not None
    for a, b in zip(before, episode(gym.make(env.spec)), strict=True):
        np.testing.assert_array_equal(a["event"], b["event"])
        np.testing.assert_array_equal(a["depth"], b["depth"])


def test_presets_and_functions_as_arguments_make_the_same_environment() -> None:
    env = EventObservation(gym.make("MovingBar-v0"), source=frame_now, camera=PRESETS["carla"])
    assert env.spec is not None
    for a, b in zip(episode(env), episode(gym.make(env.spec)), strict=True):
        np.testing.assert_array_equal(a["event"], b["event"])
