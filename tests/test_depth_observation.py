"""Depth as a wrapper: sources, encodings, range, noise of a structured-light camera, bad input."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RenderCollection
from moving_bar import HEIGHT, WIDTH, MovingBar, episode, metres, metres_now
from numpy.typing import NDArray

from sb3_have.sensors import DepthObservation, decode_depth, depth_from_zbuffer, disparity_noise, encode_depth

Env = gym.Env[Any, Any]
BOX = spaces.Box(0, 255, (HEIGHT, WIDTH, 1), np.uint8)


def lidar(**kwargs: Any) -> Env:
    return DepthObservation(MovingBar(observation="dict"), **{"source": "lidar", **kwargs})


@pytest.mark.parametrize(
    "make",
    [
        lambda **kwargs: DepthObservation(MovingBar("depth_array"), **kwargs),
        lambda **kwargs: DepthObservation(MovingBar("rgbd_tuple"), **kwargs),
        lambda **kwargs: DepthObservation(RenderCollection(MovingBar("depth_array")), **kwargs),
        lidar,
        lambda **kwargs: DepthObservation(MovingBar(), metres_now, **kwargs),
    ],
    ids=["depth_array", "rgbd_tuple", "list", "key", "function"],
)
@pytest.mark.parametrize("encoding, maximum", [("log", None), ("clipped", 50.0), ("inverse", 60.0)])
def test_the_image_is_the_code_of_the_metres(make: Callable[..., Env], encoding: Any, maximum: float | None) -> None:
    env = make(encoding=encoding, maximum=maximum)
    assert env.observation_space["depth"] == BOX  # type: ignore[index]
    for step, observation in enumerate(episode(env)):
        assert env.observation_space.contains(observation)
        image = observation["depth"]
        np.testing.assert_array_equal(image[..., 0], encode_depth(metres(step), encoding, maximum or 100.0))
        decoded = decode_depth(image[..., 0], encoding, maximum or 100.0)
        np.testing.assert_allclose(decoded[0, 2 * step], 5.0, rtol=0.03)
        assert image[0, -1] == 0 and image[-1, -1] > 0  # the sky and the ground


def test_the_code_may_take_the_place_of_the_metres() -> None:
    env = DepthObservation(MovingBar(observation="dict"), source="lidar", key="lidar")
    observation = episode(env)[2]
    assert set(observation) == {"position", "camera", "grey", "lidar"}
    assert env.observation_space["lidar"] == BOX  # type: ignore[index]
    np.testing.assert_array_equal(observation["lidar"][..., 0], encode_depth(metres(2)))


def test_beyond_the_limits_there_is_nothing() -> None:
    near = episode(lidar(limits=(0.0, 10.0)))[1]["depth"][..., 0]
    np.testing.assert_array_equal(near > 0, metres(1) == 5)
    far = episode(lidar(limits=(5.1, 30.0)))[1]["depth"][..., 0]
    np.testing.assert_array_equal(far > 0, metres(1) == 20)
    both = episode(lidar(limits=(5.0, 20.0)))[1]["depth"][..., 0]
    np.testing.assert_array_equal(both > 0, np.isfinite(metres(1)))


def test_no_distance_between_two_surfaces_is_made_up() -> None:
    env = lidar(image_size=(17, 13))
    for observation in episode(env):
        assert observation["depth"].shape == (17, 13, 1)
        assert set(np.unique(observation["depth"])) <= {0, *np.unique(encode_depth([5.0, 20.0]))}


@pytest.mark.parametrize("size", [20, 27, 80])
def test_a_smaller_image_shows_things_where_they_are(size: int) -> None:
    """The nearest pixel of the middle, not of the corner, so that depth and colour lie on each other."""
    rows, columns = np.indices((240, 240)) - 119.5
    disc = np.where(rows**2 + columns**2 < 80**2, 5.0, 20.0).astype(np.float32)
    env = DepthObservation(MovingBar(), lambda env: disc, image_size=size)
    code = env.reset()[0]["depth"][..., 0]
    middle = np.argwhere(code == code.min()).mean(axis=0)
    np.testing.assert_allclose(middle, (size - 1) / 2, atol=0.15)


def test_dropout() -> None:
    images = np.stack([observation["depth"] for observation in episode(lidar(dropout=0.3), 11)])
    there = np.stack([np.isfinite(metres(step)) for step in range(12)])[..., None]
    lost = (images == 0)[there]
    assert lost.mean() == pytest.approx(0.3, abs=4 * np.sqrt(0.21 / lost.size))
    ground = images[:, HEIGHT // 2 :] == 0
    assert (ground[1:] & ground[:-1]).mean() == pytest.approx(0.09, abs=0.01)  # other pixels every time
    assert (episode(lidar(dropout=1.0))[3]["depth"] == 0).all()


def test_same_seed_same_noise() -> None:
    env = lidar(noise={"disparity_sigma": 0.1}, dropout=0.1)

    def depth(seed: int | None) -> Any:
        return np.stack([observation["depth"] for observation in episode(env, seed=seed)])

    first = depth(7)
    np.testing.assert_array_equal(first, depth(7))
    assert (first != depth(8)).any()
    assert (first != depth(None)).any()
    assert (first != np.stack([observation["depth"] for observation in episode(lidar())])).mean() > 0.1
    np.testing.assert_array_equal(
        np.stack([observation["depth"] for observation in episode(lidar(noise={}))]),
        np.stack([observation["depth"] for observation in episode(lidar(noise="redwood"))]),
    )


# ------------------------------------------------------------------------------------------------- depth and its noise


def test_depth_from_zbuffer_inverts_the_projection() -> None:
    near, far = 0.08, 400.0
    z = np.geomspace(near, far * 0.999, 50)
    for orthographic in (False, True):
        # The third row of OpenGL's projection matrices gives -1..1, the window 0..1.
        clip = (2 * z - far - near) / (far - near) if orthographic else (far + near - 2 * far * near / z) / (far - near)
        np.testing.assert_allclose(depth_from_zbuffer((clip + 1) / 2, near, far, orthographic), z, rtol=1e-9)
        assert depth_from_zbuffer(np.ones(3, np.float32), near, far, orthographic).tolist() == [np.inf] * 3
        assert depth_from_zbuffer([0.0], near, far, orthographic) == pytest.approx(near)


def noisy(z: float, seed: int = 0, size: int = 200, **options: Any) -> NDArray[np.float64]:
    return disparity_noise(np.full((size, size), z), np.random.default_rng(seed), **options)


def test_depth_error_grows_with_the_square() -> None:
    """sigma_z = z^2 sigma_d / bf to first order."""
    errors = [noisy(z, disparity_step=0.0, lateral_sigma=0.0).std() for z in (1.0, 2.0, 4.0)]
    np.testing.assert_allclose(errors, [z**2 / 36 / 35.13 for z in (1.0, 2.0, 4.0)], rtol=0.02)
    image = noisy(4.0, disparity_step=0.0, lateral_sigma=0.0)
    assert image.mean() == pytest.approx(4.0, abs=1e-3)
    for axis in (0, 1):  # every pixel has its own
        np.testing.assert_allclose(image.std(axis=axis).mean(), errors[-1], rtol=0.02)


def test_disparity_comes_in_steps() -> None:
    for z in (1.0, 3.0, 6.0):
        steps = 35.13 / noisy(z) * 8
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
        assert abs(steps.mean() - 35.13 / z * 8) < 0.5
    exact = noisy(3.0, disparity_sigma=0.0, lateral_sigma=0.0)
    assert exact == pytest.approx(35.13 * 8 / 94)  # 93.68 eighths of a pixel
    step = 35.13 * 8 / 93 - 35.13 * 8 / 94
    assert step == pytest.approx(0.032, abs=5e-4) and pytest.approx(0.13, abs=5e-3) == 35.13 * 8 / 46 - 35.13 * 8 / 47


def test_edges_are_shuffled_sideways_and_nothing_is_mixed() -> None:
    depth = np.full((200, 40), 1.0)
    depth[:, 20:] = 3.0
    out = disparity_noise(depth, np.random.default_rng(0), lateral_sigma=0.5, disparity_sigma=0.0, disparity_step=0.0)
    np.testing.assert_allclose(np.sort(np.unique(out.round(9))), [1.0, 3.0])
    wrong = (np.abs(out - depth) > 1).mean(axis=0)
    # Beside the edge a shift of half a pixel is enough, one column on it takes one and a half: one and three sigma.
    np.testing.assert_allclose(wrong[[19, 20]], 0.1587, atol=0.1)
    assert (wrong[[18, 21]] < 0.02).all() and (wrong[[*range(16), *range(24, 40)]] == 0).all()
    still = disparity_noise(depth, np.random.default_rng(0), 0.0, disparity_sigma=0.0, disparity_step=0.0)
    np.testing.assert_allclose(still, depth)


def test_nothing_stays_nothing_and_the_farthest_is_lost() -> None:
    for gone in (0.0, -1.0, np.nan, np.inf):
        assert (noisy(gone, size=5) == 0).all()
    assert (noisy(700.0, disparity_sigma=0.0, size=5) == 0).all()  # 0.4 steps of disparity
    assert (noisy(500.0, disparity_sigma=0.0, size=5) > 0).all()


# ---------------------------------------------------------------------------------------------------------- bad input


def nothing(env: Env) -> Any:
    return None


@pytest.mark.parametrize(
    "make, error, message",
    [
        (lambda: DepthObservation(MovingBar()), ValueError, "got None; pass render_mode='depth_array' to gym.make"),
        (lambda: DepthObservation(MovingBar("rgb_array")), ValueError, "'rgb_array'; pass render_mode='depth_array'"),
        (lambda: lidar(key="grey"), ValueError, "already has the key 'grey'"),
        (lambda: DepthObservation(MovingBar(observation="dict"), "range"), KeyError, "no key 'range', only.*lidar"),
        (
            lambda: DepthObservation(MovingBar(observation="dict"), "camera"),
            ValueError,
            "'camera' must be float metres",
        ),
        (lambda: lidar(encoding="linear"), ValueError, "inverse"),
        (lambda: lidar(maximum=50.0), ValueError, "maximum=50.0 has no effect with encoding 'log'"),
        (lambda: lidar(encoding="clipped", maximum=0.5), ValueError, "maximum depth"),
        (lambda: lidar(limits=(5.0, 5.0)), ValueError, r"nearest < farthest in metres, got \(5.0, 5.0\)"),
        (lambda: lidar(limits=(-1.0, 5.0)), ValueError, "limits"),
        (lambda: lidar(dropout=1.1), ValueError, "probability in 0..1, got 1.1"),
        (lambda: lidar(noise="kinect"), ValueError, "'redwood'.*got 'kinect'"),
        (lambda: lidar(noise={"sigma": 1.0}), TypeError, "sigma"),
        (lambda: lidar(noise={"disparity_step": -1.0}), ValueError, "disparity_step >= 0.*-1.0"),
        (lambda: lidar(noise={"baseline_focal": 0.0}), ValueError, "baseline_focal > 0.*0.0"),
        (lambda: lidar(image_size=0), ValueError, "image_size"),
        (lambda: lidar(noise=True), ValueError, "'redwood'.*got True"),
        (lambda: lidar(noise=0.1), ValueError, "'redwood'.*got 0.1"),
        (lambda: DepthObservation(MovingBar(), nothing), ValueError, "float metres.*got NoneType"),
        (
            lambda: DepthObservation(MovingBar(), lambda env: np.zeros((4, 4), np.uint16)),
            ValueError,
            r"float metres \(H, W\), got uint16 \(4, 4\)",
        ),
        (lambda: depth_from_zbuffer([0.5], 2.0, 1.0), ValueError, "near < far"),
        (lambda: depth_from_zbuffer([5.0], 0.1, 10.0), ValueError, "is it in metres"),
        (lambda: disparity_noise(np.ones(4), np.random.default_rng(0)), ValueError, r"\(H, W\), got \(4,\)"),
    ],
)
def test_bad_options(make: Callable[[], Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        make()
