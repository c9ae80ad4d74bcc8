"""CarlaVision-v0 on the fake server: determinism, known answers of dynamics and reward, ends, learning."""

import hashlib
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

carla = pytest.importorskip("carla", reason="needs the client module of CARLA: pip install 'sb3_have[carla]'")

import fake_carla_fixtures  # noqa: E402
from envs import TINY  # noqa: E402
from fake_carla import Server  # noqa: E402
from fake_carla_fixtures import ALONE, SMALL, Start, fresh  # noqa: E402

from sb3_have import HAVESAC  # noqa: E402
from sb3_have.envs.carla_vision import PAPER, CarlaVisionEnv  # noqa: E402

server, start = fake_carla_fixtures.server, fake_carla_fixtures.start

STRAIGHT = np.zeros(2, dtype=np.float32)
FULL = np.array([1.0, 0.0], dtype=np.float32)
DT = 0.05


def waypoint(server: Server, vehicle: Any) -> Any:
    return server.map.get_waypoint(vehicle.get_location())


def digest(monkeypatch: pytest.MonkeyPatch, seed: int, episodes: int = 2, **options: Any) -> str:
    """Hash of all that an agent sees on a server of its own."""
    server = fresh(monkeypatch)
    env = CarlaVisionEnv(**{**SMALL, "max_episode_steps": 3, **options})
    found = hashlib.sha256()
    for episode in range(episodes):
        observation, info = env.reset(seed=None if episode else seed)
        for _ in range(3):
            for image in observation.values():
                found.update(image.tobytes())
            found.update(repr(sorted(info.items())).encode())
            observation, reward, *_, info = env.step(FULL)
            found.update(repr(reward).encode())
    env.close()
    assert server.left_behind() == []
    return found.hexdigest()


def test_the_same_seed_gives_the_same_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    first = digest(monkeypatch, 5)
    assert digest(monkeypatch, 5) == first != digest(monkeypatch, 6)
    assert digest(monkeypatch, 5, traffic_speed=None) == digest(monkeypatch, 5, traffic_speed=None)


def test_seeds_reach_the_traffic_manager(server: Server) -> None:
    env = CarlaVisionEnv(**SMALL)
    seeds = []
    for seed in (1, None, 2, 1):
        env.reset(seed=seed)
        seeds.append(server.traffic_managers[8000]._seed)
    assert seeds[0] == seeds[3] and len(set(seeds)) == 3 and None not in seeds


def test_traffic_does_not_depend_on_weather_and_sensors(server: Server, start: Start) -> None:
    def traffic(**options: Any) -> list[Any]:
        start(**options)
        return [(v.type_id, v._x, v._y) for v in server.vehicles()]

    assert traffic(weather="ClearNoon") == traffic(weather=["WetNight", "WetNoon"], modalities=("depth",))


def test_reward_and_distance_by_hand(server: Server, start: Start) -> None:
    env = start(**ALONE)
    _, reward, terminated, truncated, info = env.step(FULL)  # the fake gains 6 m/s^2
    assert info["distance"] == pytest.approx(DT * (0.3 + 0.6 + 0.9 + 1.2)) and reward == pytest.approx(0.15)
    assert info["speed"] == pytest.approx(1.2) and not (terminated or truncated) and info["end_reason"] is None
    _, reward, _, _, info = env.step(np.array([-1.0, 0.0]))  # and loses 10
    assert reward == pytest.approx(DT * (0.7 + 0.2) - 4 * 0.1) and info["distance"] == pytest.approx(0.195)
    _, reward, *_ = env.step(np.array([0.0, -0.5]))
    assert reward == pytest.approx(-4 * 0.1 * 0.5)
    server.collide((300.0, -400.0, 0.0), (0.0, 0.0, 1000.0))
    _, reward, *_ = env.step(STRAIGHT)
    assert reward == pytest.approx(-0.001 * (500 + 1000))


def test_reward_of_highway_vision(server: Server, start: Start) -> None:
    env = start(**ALONE, reward="highway", collision_ticks=20, steer_cost=0.2, brake_cost=0.5, initial_speed=10.0)
    server.collide((300.0, 400.0, 0.0))
    _, reward, *_ = env.step(np.array([-0.5, 0.0]))
    speeds = [10 - 0.25 * k for k in (1, 2, 3, 4)]
    assert reward == pytest.approx(np.mean(speeds) / 30 - 0.5 * 0.5)
    server.ego._y += 60
    _, reward, terminated, _, info = env.step(np.array([0.0, 0.0]))
    assert terminated and info["end_reason"] == "offroad"
    assert reward == pytest.approx(9.0 / 30 - 20)


def test_only_speed_along_the_lane_counts(server: Server, start: Start) -> None:
    env = start(**ALONE, initial_speed=10.0, policy_frequency=20)
    assert env.step(STRAIGHT)[1] == pytest.approx(10 * DT, rel=1e-4)
    server.ego._yaw += math.pi / 3
    _, reward, _, _, info = env.step(STRAIGHT)
    assert reward == pytest.approx(5 * DT, rel=1e-4) and info["speed"] == pytest.approx(10, rel=1e-4)
    assert info["distance"] == pytest.approx(0.75, rel=1e-4)
    bend = server.map.get_waypoint_xodr(46, -2, 200.0)
    assert bend is not None
    server.ego.set_transform(bend.transform)
    assert env.step(STRAIGHT)[1] == pytest.approx(10 * DT, rel=1e-3)


def test_actions_become_pedals(server: Server, start: Start) -> None:
    env = start(**ALONE, max_speed=5.0)
    for action, expected in [
        ((0.5, 1.0), (0.5, 0.1 / math.radians(70), 0.0)),
        ((-0.25, -0.5), (0.0, -0.05 / math.radians(70), 0.25)),
        ((7.0, 0.0), (1.0, 0.0, 0.0)),
    ]:
        env.step(np.array(action))
        control = server.ego.get_control()
        assert (control.throttle, control.steer, control.brake) == pytest.approx(expected)
        assert not (control.hand_brake or control.reverse or control.manual_gear_shift)
    for _ in range(10):
        _, _, _, _, info = env.step(FULL)
    assert 5 <= info["speed"] < 5.31 and server.ego.get_control().throttle == 0
    env = start(**ALONE, steering_range=None)
    env.step(np.array([0.0, -1.0]))
    assert server.ego.get_control().steer == -1
    with pytest.raises(ValueError, match="lock"):
        start(**ALONE, steering_range=1.3)


def test_initial_speed(server: Server, start: Start) -> None:
    env = start(**ALONE, initial_speed=17.0)
    assert env.step(STRAIGHT)[4]["distance"] == pytest.approx(17 * 0.2, rel=1e-3)


def test_twenty_colliding_ticks_end_the_episode(server: Server, start: Start) -> None:
    env = start(**ALONE, crash_penalty=3.0, collision_cost=0.0, standstill_time=math.inf)
    server.collide(*[(1.0, 0.0, 0.0)] * 19)
    for _ in range(5):
        _, reward, terminated, _, info = env.step(STRAIGHT)
        assert not terminated and not info["crashed"] and reward == 0
    server.collide((1.0, 0.0, 0.0))
    _, reward, terminated, truncated, info = env.step(STRAIGHT)
    assert terminated and not truncated and info["crashed"] and info["end_reason"] == "crash" and reward == -3
    env.reset()
    server.collide(*[(1.0, 0.0, 0.0)] * 19)  # counting starts anew
    assert not any(env.step(STRAIGHT)[2] for _ in range(6))


def test_hitting_two_cars_at_once_is_one_colliding_tick(server: Server, start: Start) -> None:
    env = start(**{**ALONE, "vehicles_count": 2}, collision_ticks=5)
    server.collide(*[(1.0, 0.0, 0.0)] * 4)
    for vehicle in server.vehicles():
        vehicle._autopilot, vehicle._speed = None, 0.0
        vehicle.set_transform(server.actors[24]._pose())
    assert not env.step(STRAIGHT)[2] and env.step(STRAIGHT)[2]


def test_collisions_that_are_reported_late_count_too(server: Server, start: Start) -> None:
    env = start(**ALONE, standstill_time=math.inf)
    server.late("sensor.other.collision", 3)
    server.collide(*[(0.0, 100.0, 0.0)] * 20)
    steps = [env.step(STRAIGHT) for _ in range(6)]
    assert [terminated for _, _, terminated, _, _ in steps] == [False] * 5 + [True]
    assert sum(float(reward) for _, reward, *_ in steps) == pytest.approx(-0.001 * 20 * 100)


def test_ends_of_highway_vision(server: Server, start: Start) -> None:
    env = start(**ALONE, reward="highway")
    for _ in range(30):  # it may stand still
        assert not env.step(STRAIGHT)[2]
    server.collide((0.0, 1.0, 0.0))
    _, reward, terminated, _, info = env.step(STRAIGHT)
    assert terminated and info["crashed"] and info["end_reason"] == "crash" and reward == pytest.approx(-20)
    env = start(**ALONE, reward="highway", collision_ticks=2, standstill_time=0.4)
    server.collide((0.0, 1.0, 0.0))
    assert [env.step(STRAIGHT)[2] for _ in range(2)] == [False, True]


def test_the_papers_ends(server: Server, start: Start) -> None:
    paper = {**PAPER, **ALONE, "initial_speed": 10.0}
    env = start(**paper)
    server.ego._y += 60
    for _ in range(3):
        _, _, terminated, truncated, info = env.step(STRAIGHT)
        assert info["offroad"] and info["end_reason"] is None and not (terminated or truncated)
    server.collide(*[(1.0, 0.0, 0.0)] * 20)
    assert [env.step(STRAIGHT)[2] for _ in range(20)] == [False] * 19 + [True]
    env.reset()
    env.step(np.array([-1.0, 0.0]))
    steps, terminated = 1, False
    while not terminated:
        _, _, terminated, _, info = env.step(np.array([-1.0, 0.0]))
        steps += 1
    assert info["end_reason"] == "standstill" and steps == pytest.approx(20 * (1 + 5), abs=2)  # 1 s to stop
    assert env.max_episode_steps == 1000


def test_late_collisions_of_before_the_episode_do_not_count(server: Server, start: Start) -> None:
    server.late("sensor.other.collision", 3)
    server.collide(*[(1.0, 0.0, 0.0)] * 10)  # the last in the last tick before the episode
    env = start(**ALONE, collision_ticks=1)
    assert server.sent["sensor.other.collision"][server.frame]
    for _ in range(2):
        _, reward, terminated, *_ = env.step(STRAIGHT)
        assert reward == 0 and not terminated


def test_collisions_before_the_episode_do_not_count(server: Server, start: Start) -> None:
    server.collide(*[(1.0, 0.0, 0.0)] * 10)  # while the cars fall onto the road
    env = start(**ALONE, collision_ticks=1)
    _, reward, terminated, *_ = env.step(STRAIGHT)
    assert reward == 0 and not terminated


def test_stepping_on_after_the_end_is_told(server: Server, start: Start) -> None:
    env = start(**ALONE, max_episode_steps=1)
    env.step(STRAIGHT)
    with pytest.warns(UserWarning, match="after the end"):
        env.step(STRAIGHT)


def test_standing_still_ends_the_episode(server: Server, start: Start) -> None:
    env = start(**ALONE)
    for step in range(25):
        _, _, terminated, _, info = env.step(STRAIGHT)
        assert terminated == (step == 24)
    assert info["end_reason"] == "standstill" and not info["crashed"]
    env.reset()
    ends = [env.step(FULL if step % 20 == 10 else np.array([-1.0, 0.0]))[2] for step in range(34)]
    assert not any(ends)
    env = start(**ALONE, standstill_time=math.inf)
    assert not any(env.step(STRAIGHT)[2] for _ in range(30))


def test_leaving_the_road_ends_the_episode(server: Server, start: Start) -> None:
    env = start(**ALONE, initial_speed=10.0, crash_penalty=20.0)
    first = waypoint(server, server.ego)
    terminated, lanes = False, []
    while not terminated:
        lanes.append(waypoint(server, server.ego))
        _, reward, terminated, truncated, info = env.step(np.array([0.3, 1.0]))
    assert info["offroad"] and info["end_reason"] == "offroad" and reward < -15 and not truncated
    assert sorted({lane.lane_id for lane in lanes}) == list(range(-4, first.lane_id + 1))  # over all lanes to the right
    outermost = waypoint(server, server.ego)
    beside = server.ego.get_location().distance(outermost.transform.location)
    assert outermost.lane_id == -4 and 1.75 < beside < 6


def test_the_step_limit_truncates(server: Server) -> None:
    for env in (CarlaVisionEnv(**ALONE, max_episode_steps=2), gym.make("CarlaVision-v0", max_episode_steps=2, **ALONE)):
        env.reset(seed=0)
        assert env.step(FULL)[3] is False
        _, _, terminated, truncated, info = env.step(FULL)
        assert truncated and not terminated and info["end_reason"] == "timeout"
        env.close()


def test_havesac_learns_on_it(server: Server) -> None:
    env = CarlaVisionEnv(image_size=32, vehicles_count=2, timeout=1.0, max_episode_steps=6, initial_speed=10.0)
    model = HAVESAC(
        "MultiInputPolicy", env, buffer_size=50, learning_starts=4, batch_size=4, seed=0, policy_kwargs=TINY
    )
    model.learn(15)
    assert model.num_timesteps == 15 and model._n_updates > 5
    env.close()
    assert server.left_behind() == []
