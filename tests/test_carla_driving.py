"""CarlaVision-v0 on the fake server: reward, distance, pedals, and the ends of an episode."""

import math

import gymnasium as gym
import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from fake_carla_fixtures import ALONE, FULL, STRAIGHT, Start  # noqa: E402
from fake_carla_server import COLLISION, Server  # noqa: E402

from sb3_have.envs.carla_vision import PAPER, CarlaVisionEnv  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

DT = 0.05
BRAKE = np.array([-1.0, 0.0], dtype=np.float32)
HIT = (1.0, 0.0, 0.0)


def test_paper_reward_and_distance(server: Server, start: Start) -> None:
    env = start(**ALONE)
    _, reward, terminated, truncated, info = env.step(FULL)
    assert info["distance"] == pytest.approx(DT * (0.3 + 0.6 + 0.9 + 1.2)) and reward == pytest.approx(0.15)
    assert info["speed"] == pytest.approx(1.2) and not (terminated or truncated) and info["end_reason"] is None
    _, reward, _, _, info = env.step(BRAKE)
    assert reward == pytest.approx(DT * (0.7 + 0.2) - 4 * 0.1) and info["distance"] == pytest.approx(0.195)
    assert env.step(np.array([0.0, -0.5]))[1] == pytest.approx(-4 * 0.1 * 0.5)
    server.collide((300.0, -400.0, 0.0), (0.0, 0.0, 1000.0))
    assert env.step(STRAIGHT)[1] == pytest.approx(-0.001 * (500 + 1000))


def test_highway_reward(server: Server, start: Start) -> None:
    env = start(**ALONE, reward="highway", collision_ticks=20, steer_cost=0.2, brake_cost=0.5, initial_speed=10.0)
    server.collide((300.0, 400.0, 0.0))
    speeds = [10 - 0.25 * k for k in (1, 2, 3, 4)]
    assert env.step(np.array([-0.5, 0.0]))[1] == pytest.approx(np.mean(speeds) / 30 - 0.5 * 0.5)
    server.ego._y += 60
    _, reward, terminated, _, info = env.step(STRAIGHT)
    assert terminated and info["end_reason"] == "offroad" and reward == pytest.approx(9.0 / 30 - 20)


def test_only_speed_along_the_lane_counts(server: Server, start: Start) -> None:
    env = start(**ALONE, initial_speed=10.0, policy_frequency=20)
    assert env.step(STRAIGHT)[1] == pytest.approx(10 * DT, rel=1e-4)
    server.ego._yaw += math.pi / 3
    _, reward, _, _, info = env.step(STRAIGHT)
    assert reward == pytest.approx(5 * DT, rel=1e-4) and info["speed"] == pytest.approx(10, rel=1e-4)
    assert info["distance"] == pytest.approx(0.75, rel=1e-4)


def test_pedals(server: Server, start: Start) -> None:
    env = start(**ALONE, max_speed=5.0)
    for action, expected in [
        ((0.5, 1.0), (0.5, 0.1 / math.radians(70), 0.0)),
        ((-0.25, -0.5), (0.0, -0.05 / math.radians(70), 0.25)),
        ((7.0, 0.0), (1.0, 0.0, 0.0)),
    ]:
        env.step(np.array(action))
        control = server.ego._control
        assert (control.throttle, control.steer, control.brake) == pytest.approx(expected)
        assert not (control.hand_brake or control.reverse or control.manual_gear_shift)
    for _ in range(10):
        info = env.step(FULL)[4]
    assert 5 <= info["speed"] < 5.31 and server.ego._control.throttle == 0
    env = start(**ALONE, steering_range=None)
    env.step(np.array([0.0, -1.0]))
    assert server.ego._control.steer == -1
    with pytest.raises(ValueError, match="lock"):
        start(**ALONE, steering_range=1.3)


def test_crash_after_twenty_colliding_ticks(server: Server, start: Start) -> None:
    env = start(**ALONE, crash_penalty=3.0, collision_cost=0.0, standstill_time=math.inf)
    server.collide(*[HIT] * 38, at_once=2)  # hitting two cars at once is one colliding tick
    for _ in range(5):
        _, reward, terminated, _, info = env.step(STRAIGHT)
        assert not terminated and not info["crashed"] and reward == 0
    server.collide(HIT)
    _, reward, terminated, truncated, info = env.step(STRAIGHT)
    assert terminated and not truncated and info["crashed"] and info["end_reason"] == "crash" and reward == -3
    # Counting starts at 0 in the next episode
    env.reset()
    server.collide(*[HIT] * 19)
    assert not any(env.step(STRAIGHT)[2] for _ in range(6))


def test_late_reports_of_collisions_count(server: Server, start: Start) -> None:
    env = start(**ALONE, standstill_time=math.inf)
    server.disturb(COLLISION, late=3)
    server.collide(*[(0.0, 100.0, 0.0)] * 20)
    steps = [env.step(STRAIGHT) for _ in range(6)]
    assert [terminated for _, _, terminated, _, _ in steps] == [False] * 5 + [True]
    assert sum(float(reward) for _, reward, *_ in steps) == pytest.approx(-0.001 * 20 * 100)


@pytest.mark.parametrize("late", [0, 3])
def test_collisions_before_the_episode_do_not_count(server: Server, start: Start, late: int) -> None:
    server.disturb(COLLISION, late=late)
    server.collide(*[HIT] * 10)  # until the last tick before the episode
    env = start(**ALONE, collision_ticks=1)
    assert server.sent[COLLISION][server.frame]
    for _ in range(2):
        _, reward, terminated, *_ = env.step(STRAIGHT)
        assert reward == 0 and not terminated


def test_highway_ends(server: Server, start: Start) -> None:
    env = start(**ALONE, reward="highway")
    assert not any(env.step(STRAIGHT)[2] for _ in range(30))  # it may stand still
    server.collide(HIT)
    _, reward, terminated, _, info = env.step(STRAIGHT)
    assert terminated and info["end_reason"] == "crash" and reward == pytest.approx(-20)


def test_paper_ends(server: Server, start: Start) -> None:
    env = start(**{**PAPER, **ALONE, "initial_speed": 10.0})
    server.ego._y += 60
    for _ in range(3):
        _, _, terminated, truncated, info = env.step(STRAIGHT)
        assert info["offroad"] and info["end_reason"] is None and not (terminated or truncated)
    server.collide(*[HIT] * 20)
    assert [env.step(STRAIGHT)[2] for _ in range(20)] == [False] * 19 + [True]
    env.reset()
    steps, terminated = 0, False
    while not terminated:
        _, _, terminated, _, info = env.step(BRAKE)
        steps += 1
    assert info["end_reason"] == "standstill" and steps == pytest.approx(20 * (1 + 5), abs=2)  # 1 s to stop
    assert env.max_episode_steps == 1000


def test_standstill(server: Server, start: Start) -> None:
    env = start(**ALONE, crash_penalty=5.0)
    for step in range(25):
        _, reward, terminated, _, info = env.step(STRAIGHT)
        assert terminated == (step == 24) and reward == 0  # no penalty at the end
    assert info["end_reason"] == "standstill" and not info["crashed"]
    with pytest.warns(UserWarning, match="after the end"):
        env.step(STRAIGHT)
    env.reset()
    assert not any(env.step(FULL if step % 20 == 10 else BRAKE)[2] for step in range(34))


def test_leaving_the_road(server: Server, start: Start) -> None:
    env = start(**ALONE, initial_speed=10.0, crash_penalty=20.0)
    terminated, lanes = False, []
    while not terminated:
        lanes.append(server.map.get_waypoint(server.ego.get_location()).lane_id)
        _, reward, terminated, truncated, info = env.step(np.array([0.3, 1.0]))
    assert info["offroad"] and info["end_reason"] == "offroad" and reward < -15 and not truncated
    assert sorted(set(lanes)) == list(range(-4, lanes[0] + 1))  # across all lanes on the right
    outermost = server.map.get_waypoint(server.ego.get_location())
    lateral = server.ego.get_location().distance(outermost.transform.location)
    assert outermost.lane_id == -4 and 1.75 < lateral < 6


def test_step_limit(server: Server) -> None:
    for env in (CarlaVisionEnv(**ALONE, max_episode_steps=2), gym.make("CarlaVision-v0", max_episode_steps=2, **ALONE)):
        env.reset(seed=0)
        assert env.step(FULL)[3] is False
        _, _, terminated, truncated, info = env.step(FULL)
        assert truncated and not terminated and info["end_reason"] == "timeout"
        env.close()
