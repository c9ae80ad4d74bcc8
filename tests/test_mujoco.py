"""MuJoCo seen by three cameras. Rendering without a screen needs EGL; the skip says what is missing."""

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_have import HAVESAC
from sb3_have.sensors import DepthObservation, EventObservation, RenderObservation, decode_depth

Env = gym.Env[Any, Any]
PACKAGES = "Debian and Ubuntu: apt install libegl1 libopengl0 libgl1-mesa-dri"
PROBE = """
import gymnasium as gym
env = gym.make("InvertedPendulum-v5", render_mode="rgb_array", width=8, height=8)
env.reset()
assert env.render().shape == (8, 8, 3)
"""


@cache
def missing() -> str | None:
    """Why MuJoCo cannot render here; found out in a process of its own, which a broken driver may take down."""
    if importlib.util.find_spec("mujoco") is None:
        return "mujoco is not installed: pip install gymnasium[mujoco]"
    try:
        probe = subprocess.run(
            [sys.executable, "-c", PROBE],
            env={**os.environ, "MUJOCO_GL": "egl"},
            cwd=os.environ.get("TMPDIR", "/tmp"),
            capture_output=True,
            text=True,
            timeout=1800,
        )
    except subprocess.TimeoutExpired:
        return f"MuJoCo hangs when it renders with EGL ({PACKAGES})"
    if probe.returncode:
        errors = re.findall(r"^\w+Error: .*$", probe.stderr, re.MULTILINE) or [f"exit code {probe.returncode}"]
        return f"MuJoCo cannot render with EGL: {errors[0]} ({PACKAGES})"
    return None


@pytest.fixture(autouse=True)
def mujoco_renders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    # gymnasium reads this when it first renders, mujoco when it is first imported.
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves MUJOCO_LOG.TXT behind
    yield


def cheetah(size: int = 36) -> Env:
    """Colour, events and depth of one rendering."""
    env: Env = gym.make("HalfCheetah-v5", render_mode="rgbd_tuple", width=size, height=size)
    return DepthObservation(EventObservation(RenderObservation(env)), limits=(0.0, 40.0))


def test_half_cheetah_in_colour_events_and_depth() -> None:
    env = cheetah(48)
    base: Any = env.unwrapped
    renderings = 0
    render = base.render

    def counted() -> Any:
        nonlocal renderings
        renderings += 1
        return render()

    base.render = counted
    env.action_space.seed(0)
    observations = [env.reset(seed=0)[0]]
    observations += [env.step(env.action_space.sample())[0] for _ in range(8)]
    assert renderings == len(observations)
    assert all(env.observation_space.contains(observation) for observation in observations)
    first, last = observations[0], observations[-1]
    assert {key: image.shape for key, image in last.items()} == {
        "state": (17,),
        "rgb": (48, 48, 3),
        "event": (48, 48, 5),
        "depth": (48, 48, 1),
    }
    assert last["rgb"].std() > 10
    assert (first["event"] == 128).all() and 0.001 < (last["event"] != 128).mean() < 0.5
    # The camera stands 3 to 4 m from the cheetah and looks down on a floor.
    metres = decode_depth(last["depth"])[..., 0]
    assert 1.0 < metres[24, 24] < 6.0
    assert metres[40, 4] < metres[30, 4]
    env.close()


def test_havesac_trains_on_half_cheetah() -> None:
    env = cheetah()
    tiny = {"features_dim": 8, "net_arch": [16], "precision": "float32"}
    model = HAVESAC(
        "MultiInputPolicy", env, learning_starts=8, batch_size=8, buffer_size=100, policy_kwargs=tiny, device="cpu"
    )
    model.learn(30)
    assert model._n_updates == 22
    weights = model.modality_weights(model.env.reset())  # type: ignore[union-attr,arg-type]
    assert set(weights) == {"rgb", "event", "depth", "state"}
    env.close()


WORKERS = """
import gymnasium as gym, numpy as np
from sb3_have.sensors import DepthObservation, EventObservation, RenderObservation

def cheetah():
    env = gym.make("HalfCheetah-v5", render_mode="rgbd_tuple", width=36, height=36)
    env = DepthObservation(EventObservation(RenderObservation(env)))
    return DepthObservation(env, source=lambda env: np.ones((4, 4), np.float32), key="flat", image_size=4)

env = gym.vector.AsyncVectorEnv([cheetah, cheetah])
first = env.reset(seed=0)[0]
last = env.step(np.ones((2, 6), np.float32))[0]
assert first["rgb"].std() > 10 and (last["event"] != 128).any(), "black"
env.close()
"""


def test_worker_processes_render(tmp_path: Path) -> None:
    """
    The children of a process that has rendered hang. AsyncVectorEnv makes one environment before it forks, so making
    one must not render. In a process of its own: this one has rendered.
    """
    done = subprocess.run([sys.executable, "-c", WORKERS], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("wrapper", [DepthObservation, EventObservation])
def test_a_function_needs_a_size(wrapper: Any) -> None:
    """Finding it out would render."""
    env: Env = gym.make("HalfCheetah-v5", render_mode="rgb_array", width=36, height=36)
    with pytest.raises(ValueError, match=rf"{wrapper.__name__}: a function as source needs image_size="):
        wrapper(RenderObservation(env), source=lambda env: np.ones((4, 4), np.float32))
    assert env.unwrapped.mujoco_renderer.viewer is None  # type: ignore[attr-defined]


BOX = """
<mujoco>
  <statistic extent="{extent}"/>
  <visual>
    <map znear="0.02" zfar="20"/>
    <global fovy="4" orthographic="true"/>
  </visual>
  <asset>{sky}</asset>
  <worldbody>
    <camera name="eye" pos="0 0 0" xyaxes="0 -1 0 0 0 1" fovy="60"/>
    <camera name="wide" pos="0 0 0" xyaxes="0 -1 0 0 0 1" fovy="120"/>
    <camera name="parallel" pos="0 0 0" xyaxes="0 -1 0 0 0 1" fovy="4" projection="orthographic"/>
    <geom type="box" pos="3.5 0.5 0" size="0.5 0.5 1"/>
    <geom type="box" pos="8 -4 0" size="0.25 4 1"/>
  </worldbody>
</mujoco>
"""


SKY = '<texture type="skybox" builtin="gradient" rgb1="0.4 0.6 0.8" rgb2="0 0 0" width="32" height="192"/>'


@pytest.mark.parametrize("sky", ["", SKY], ids=["no sky", "skybox"])
@pytest.mark.parametrize("extent", [1.0, 4.0])
@pytest.mark.parametrize("camera", ["eye", "wide", "parallel", None])
def test_depth_of_a_known_scene(tmp_path: Path, extent: float, camera: str | None, sky: str) -> None:
    """
    A camera at the origin looks along x: a box from 3 m on to the left, a wall at 7.75 m to the right, sky above. A
    skybox is drawn as a wall, whose depth in the corners of a wide view is less than half of that in the middle.
    """
    from gymnasium.envs.mujoco import MujocoEnv

    model = tmp_path / "boxes.xml"
    model.write_text(BOX.format(extent=extent, sky=sky))

    class Boxes(MujocoEnv):
        metadata = {"render_modes": ["depth_array", "rgbd_tuple"]}  # noqa: RUF012

        def __init__(self) -> None:
            space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
            look = {"lookat": np.zeros(3), "distance": 1e-6, "azimuth": 0.0, "elevation": 0.0, "orthographic": 1}
            super().__init__(
                str(model),
                1,
                space,
                "rgbd_tuple",
                64,
                64,
                default_camera_config=look,  # type: ignore[arg-type]
                camera_name=camera,
            )

        def reset_model(self) -> Any:
            self.set_state(self.init_qpos, self.init_qvel)  # type: ignore[no-untyped-call]
            return np.zeros(1, np.float32)

    env = DepthObservation(Boxes(), encoding="clipped", maximum=25.4)
    depth = decode_depth(env.reset(seed=0)[0]["depth"], "clipped", 25.4)[..., 0]
    step = 0.1  # of the code
    if camera == "wide":
        assert depth[32, 30] == pytest.approx(3.0, abs=step) and depth[32, 40] == pytest.approx(7.75, abs=step)
        assert (depth[:20] == 0).all() and (depth[-20:] == 0).all() and (depth[:, :16] == 0).all()
        return
    assert depth[32, 27] == pytest.approx(3.0, abs=step)
    assert depth[32, 40] == pytest.approx(7.75, abs=step)  # its distance along the axis, not along the ray
    assert depth[32, 55] == pytest.approx(7.75, abs=step)
    if camera == "eye":
        assert (depth[:4] == 0).all()
        assert (depth[20] == 0).sum() == 64 - 18  # 1 m at 3 m is 18 pixels wide; the wall is not as high
    else:
        assert (depth[16:48, 16:32] > 0).all()  # 1 m is 16 pixels wherever it is
        assert (depth == 0).sum() == 64**2 - 32 * 16 - 32 * 32
    env.close()


@pytest.mark.parametrize("env_id, camera", [("Hopper-v5", None), ("Hopper-v5", "track"), ("Walker2d-v5", "track")])
def test_the_sky_of_a_stock_model_is_nothing(env_id: str, camera: str | None) -> None:
    """Against rays cast from the camera: where they hit nothing, and nowhere else, there is nothing."""
    mujoco = pytest.importorskip("mujoco")
    made: Env = gym.make(env_id, render_mode="rgbd_tuple", width=48, height=48, camera_name=camera)
    env = DepthObservation(made)
    code = env.reset(seed=0)[0]["depth"][..., 0]
    base: Any = env.unwrapped
    eye = base.mujoco_renderer.viewer.scn.camera[0]
    forward, up = np.array(eye.forward, np.float64), np.array(eye.up, np.float64)
    # The frustum of a pixel's middle; the view is square and centred.
    rows, columns = (2 * (np.indices((48, 48)) + 0.5) / 48 - 1) * eye.frustum_top / eye.frustum_near
    rays = forward - rows[..., None] * up + columns[..., None] * np.cross(forward, up)
    free = np.empty((48, 48), bool)
    for pixel in np.ndindex(48, 48):
        hit = np.zeros(1, np.int32)
        start = np.array(eye.pos, np.float64)
        free[pixel] = mujoco.mj_ray(base.model, base.data, start, rays[pixel], None, True, -1, hit, None) < 0
    assert 0.1 < free.mean() < 0.9
    edge = np.zeros_like(free)
    for axis in (0, 1):
        for shift in (-1, 1):
            edge |= free != np.roll(free, shift, axis)
    np.testing.assert_array_equal((code == 0)[~edge], free[~edge])
    env.close()
