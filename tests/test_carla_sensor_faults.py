"""CarlaVision-v0 when a sensor sends nothing, too late, the wrong frame or rubbish."""

import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla import Server  # noqa: E402
from fake_carla_fixtures import FULL, Start, works  # noqa: E402

from sb3_have.envs.carla_vision import CarlaConnectionError, CarlaVisionEnv  # noqa: E402

server, env, start = fake_carla_fixtures.server, fake_carla_fixtures.env, fake_carla_fixtures.start

RGB, DEPTH, DVS = (f"sensor.camera.{name}" for name in ("rgb", "depth", "dvs"))


def test_ticks_without_events(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    server.drop(DVS, 4)
    assert (env.step(FULL)[0]["event"] == 128).all()
    server.drop(DVS, 2)
    first = server.frame + 1
    event = env.step(FULL)[0]["event"]
    sent = sum(len(server.sent[DVS][frame]) for frame in range(first + 2, first + 4))
    assert (event[..., :2] == 128).all() and (event[..., 3:] != 128).any() and sent > 0


def test_events_of_another_step_are_not_taken_for_this_one(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    server.late(DVS, 4)
    assert (env.step(FULL)[0]["event"] == 128).all()
    server.late(DVS, 0)
    server.drop(DVS, 4)
    with pytest.warns(UserWarning, match=r"events of 4 ticks .* event_grace = 0\.02 s .* dropped"):
        assert (env.step(FULL)[0]["event"] == 128).all()
    server.late(DVS, 4)
    env.step(FULL)
    env.step(FULL)  # told once


def test_events_that_come_after_the_grace_are_told_and_before_it_are_seen(server: Server, start: Start) -> None:
    alone = {"modalities": ("event",), "initial_speed": 10.0}
    for grace in (0.0, 5.0):
        env = start(**alone, event_grace=grace)
        server.slow(DVS, 0.05)
        event = env.step(FULL)[0]["event"]
        assert (event != 128).any() == bool(grace)
        server.join()
        server.heal()
        if not grace:
            with pytest.warns(UserWarning, match=r"events of 4 ticks"):
                env.step(FULL)


def test_late_events_of_before_the_episode_are_nobodys(server: Server, start: Start) -> None:
    env = start(vehicles_count=0, initial_speed=10.0)
    env.step(FULL)  # fast, so that settling would have events
    server.late(DVS, 2)
    env.reset()
    server.late(DVS, 0)
    env.step(FULL)


@pytest.mark.parametrize("kind", [RGB, DEPTH])
def test_an_image_that_is_late(server: Server, env: CarlaVisionEnv, kind: str) -> None:
    env.reset(seed=0)
    server.late(kind, 1)
    name = kind.rsplit(".")[-1]
    with pytest.raises(TimeoutError, match=rf"frame {server.frame + 4} from the {name} sensor within 0.1 s"):
        env.step(FULL)
    assert server.left_behind() == []
    works(server, env)


def test_a_server_that_dies_between_the_tick_and_the_image(server: Server, start: Start) -> None:
    env = start(vehicles_count=0, timeout=0.2)
    server.drop(RGB, 10**6)
    server.die("Client.get_server_version")  # the first that is asked after the wait
    with pytest.raises(CarlaConnectionError, match="lost the CARLA server at localhost:2000") as caught:
        env.step(FULL)
    assert isinstance(caught.value.__cause__, TimeoutError) and "rgb" in str(caught.value.__cause__)
    server.restart()
    works(server, env)


@pytest.mark.parametrize("kind", [RGB, DEPTH])
def test_an_image_that_is_missing(server: Server, env: CarlaVisionEnv, kind: str) -> None:
    server.drop(kind, 10**6)
    with pytest.raises(TimeoutError, match=kind.rsplit(".")[-1]):
        env.reset()
    assert server.left_behind() == []
    works(server, env)


def test_one_missing_image_within_a_step_does_not_matter(server: Server, env: CarlaVisionEnv) -> None:
    env.reset(seed=0)
    server.drop(RGB, 3)
    observation = env.step(FULL)[0]
    np.testing.assert_array_equal(observation["rgb"], server.sent[RGB][server.frame][..., [2, 1, 0]])


@pytest.mark.parametrize("kind", [RGB, DEPTH, DVS])
def test_data_that_comes_a_little_after_the_tick(server: Server, start: Start, kind: str) -> None:
    # a busy machine starts threads late
    env = start(timeout=5.0, event_grace=5.0, initial_speed=10.0)
    prompt = env.step(FULL)[0]
    env.reset(seed=0)
    server.slow(kind, 0.03)
    observation = env.step(FULL)[0]
    server.join()
    name = {RGB: "rgb", DEPTH: "depth", DVS: "event"}[kind]
    assert (observation["event"] != 128).any()
    np.testing.assert_array_equal(observation[name], prompt[name])


@pytest.mark.parametrize(("by", "error"), [(1, RuntimeError), (-1, TimeoutError)])
@pytest.mark.parametrize("kind", [RGB, DEPTH])
def test_wrong_frame_numbers(server: Server, env: CarlaVisionEnv, kind: str, by: int, error: type[Exception]) -> None:
    env.reset(seed=0)
    server.misnumber(kind, by)
    due = server.frame + 4
    with pytest.raises(error, match=rf"{kind.rsplit('.')[-1]}.*{due}|{due}.*{kind.rsplit('.')[-1]}"):
        if by > 0:  # the queue still holds the frame before
            server.drop(kind, 3)
        env.step(FULL)
    assert server.left_behind() == []
    works(server, env)


@pytest.mark.parametrize("kind", [RGB, DEPTH, DVS])
def test_an_exception_in_a_callback(
    server: Server, env: CarlaVisionEnv, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    env.reset(seed=0)
    server.corrupt(kind)
    name = "event" if kind == DVS else kind.rsplit(".")[-1]
    with pytest.raises(RuntimeError, match=f"callback of the {name} sensor failed") as caught:
        env.step(FULL)
    assert isinstance(caught.value.__cause__, ValueError)
    assert server.left_behind() == [] and not capsys.readouterr().err
    works(server, env)


def test_old_images_do_not_reach_the_next_episode(server: Server, start: Start) -> None:
    env = start(timeout=5.0)
    server.slow(RGB, 0.02)
    for _ in range(2):
        env.reset()
        observation = env.step(FULL)[0]
        server.join()
        np.testing.assert_array_equal(observation["rgb"], server.sent[RGB][server.frame][..., [2, 1, 0]])
