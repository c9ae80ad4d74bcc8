"""HighwayVision-v0: drive along a busy road, seen through an RGB camera, an event camera and a depth camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import ContinuousAction
from highway_env.envs.common.observation import ObservationType

from sb3_have.envs import traffic
from sb3_have.envs.driver import NeverReverses
from sb3_have.envs.lanes import FORWARD, ShapedNetwork
from sb3_have.envs.road import LANE_WIDTH, SPEED_LIMIT, HighwayNetwork, HighwayRoad
from sb3_have.envs.road_shape import PERIOD, road_shape
from sb3_have.envs.vision import VisionSensors, compose
from sb3_have.envs.weather import weather_choices

HEAD_ON_FREQUENCY = 3
"""Least simulation frequency at which no cars miss each other head-on [Hz]: highway-env looks one step of the one car
ahead, and the other, at 30 m/s, may come no farther in a step than both cars are long."""

START_X = 1000.0
"""Where the ego vehicle starts along the road [m]: far from the road's own ends."""


class EgoVehicle(NeverReverses):
    """The car that the actions drive."""


class VisionObservation(ObservationType):
    """What the sensors of a :class:`HighwayVisionEnv` deliver; they live on the env, which outlives its resets."""

    def space(self) -> spaces.Dict:
        return spaces.Dict(self.env.sensors.spaces)

    def observe(self) -> dict[str, np.ndarray]:
        observation: dict[str, np.ndarray] = self.env.observe_sensors()
        return observation


class HighwayVisionEnv(AbstractEnv):
    """A road with traffic, continuous throttle and steering, and images for observations.

    Observation: a Dict of uint8 images (H, W, C), 0 to 255: ``rgb`` (C=3), ``event`` (C=5 temporal bins of signed
    event counts, stored as 128 + count), ``depth`` (C=1, logarithmic). Action: ``Box(-1, 1, (2,))`` =
    [throttle, steer]; throttle maps to +-5 m/s^2, positive steer goes right. Reward per step::

        v_s / max_speed - steer_cost * |steer| - brake_cost * max(0, -throttle) - crash_penalty * (crashed or off road)

    with v_s the mean speed along the road during the step [m/s], the motion projected on its direction. A crash or
    leaving the road terminates the episode, ``max_episode_steps`` truncates it. ``info`` after reset and every step:
    ``distance`` (sum of v_s dt so far [m]), ``speed`` [m/s], ``crashed``, ``offroad``, ``weather``, ``end_reason``
    ("crash", "offroad", "timeout" or None).

    The traffic is highway-env's IDM/MOBIL drivers in a window that moves along (:mod:`sb3_have.envs.traffic`). The
    same seed gives the same bits; traffic and sensors draw from separate streams, so that episodes with the same seed
    meet the same traffic in any weather and with any set of modalities.

    Scenarios:

    - "highway": straight, all lanes in one direction;
    - "merge": the same with an on-ramp from the right every 480 m. Its slow traffic speeds up on an acceleration lane
      of 180 m and cuts in where MOBIL holds it to be safe, less and less choosy towards the end. The ego vehicle may
      drive there, too, while the lane lasts;
    - "curves": a winding road, a sine of 12 m and period 480 m (radius 486 m and more; full lock of the default
      ``steering_range`` is 250 m), half of its lanes for oncoming traffic behind a double solid line. Driving there
      is possible and counts as road, but its traffic is bound to come; it brakes for who comes head-on, and never
      changes sides itself.

    In the latter two the ego vehicle starts at a random place of the period.

    :param weather: one of :data:`sb3_have.envs.weather.WEATHERS`, a list to draw from each episode, or "random" for
        any of the eight; ``reset(options={"weather": ...})`` takes the same and holds for that episode only
    :param modalities: any of "rgb", "event", "depth"
    :param image_size: height and width of the images [px]
    :param vehicles_count: other vehicles in the window of 440 m
    :param traffic_speed: range of the speeds the others want to drive at [m/s]; by default as in highway-env, 70 to
        80% of its limit of 30 m/s
    :param lanes_count: number of lanes in all, not counting ramps; even in "curves"
    :param max_episode_steps: control steps per episode, or None for no limit
    :param initial_speed: of the ego vehicle [m/s], in 0 to ``max_speed``
    :param simulation_frequency: [Hz], a multiple of ``policy_frequency``, and 3 or more in "curves"
    :param policy_frequency: control steps per second [Hz]
    :param steering_range: steering angle at full lock [rad]
    :param max_speed: top speed [m/s]; the car does not reverse
    :param steer_cost: reward weight, see above
    :param brake_cost: reward weight, see above
    :param crash_penalty: reward weight, see above
    :param event: settings of the event camera, see :class:`sb3_have.envs.vision.VisionSensors`
    :param depth: settings of the depth camera, see :class:`sb3_have.envs.vision.VisionSensors`
    :param render_mode: None or "rgb_array" (RGB | event | depth side by side)
    :param scenario: "highway", "merge" or "curves", see above
    :raises ValueError: for any option outside of what is stated here
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (declared so by gymnasium)
    observation_space: spaces.Space[Any]

    def __init__(
        self,
        weather: str | Sequence[str] = "random",
        modalities: Sequence[str] = ("rgb", "event", "depth"),
        image_size: int = 84,
        vehicles_count: int = 20,
        traffic_speed: tuple[float, float] = (21.0, 24.0),
        lanes_count: int = 4,
        max_episode_steps: int | None = 500,
        initial_speed: float = 0.0,
        simulation_frequency: int = 20,
        policy_frequency: int = 5,
        steering_range: float = 0.02,
        max_speed: float = 30.0,
        steer_cost: float = 0.1,
        brake_cost: float = 0.1,
        crash_penalty: float = 20.0,
        event: Mapping[str, Any] | None = None,
        depth: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        scenario: str = "highway",
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        for name, value, least in [
            ("vehicles_count", vehicles_count, 0),
            ("lanes_count", lanes_count, 1),
            ("max_episode_steps", 1 if max_episode_steps is None else max_episode_steps, 1),
            ("policy_frequency", policy_frequency, 1),
            ("simulation_frequency", simulation_frequency, 1),
        ]:
            if not isinstance(value, int | np.integer) or value < least:
                raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
        if simulation_frequency % policy_frequency:
            raise ValueError(
                f"simulation_frequency ({simulation_frequency} Hz) must be a multiple of "
                f"policy_frequency ({policy_frequency} Hz), or control steps would lose time"
            )
        if scenario == "curves" and simulation_frequency < HEAD_ON_FREQUENCY:
            raise ValueError(
                f"simulation_frequency must be >= {HEAD_ON_FREQUENCY} Hz in scenario 'curves', or cars would pass "
                f"through each other head-on; got {simulation_frequency!r}"
            )
        for name, positive in [("max_speed", max_speed), ("steering_range", steering_range)]:
            if not (np.isfinite(positive) and positive > 0):
                raise ValueError(f"{name} must be positive, got {positive!r}")
        if not 0 <= initial_speed <= max_speed:
            raise ValueError(f"initial_speed must lie in 0..max_speed ({max_speed} m/s), got {initial_speed!r}")
        if np.shape(traffic_speed) != (2,) or not 0 < traffic_speed[0] <= traffic_speed[1] <= SPEED_LIMIT:
            raise ValueError(f"traffic_speed must be a range within 0..{SPEED_LIMIT} m/s, got {traffic_speed!r}")
        for name, weight in [("steer_cost", steer_cost), ("brake_cost", brake_cost), ("crash_penalty", crash_penalty)]:
            if not (np.isfinite(weight) and weight >= 0):
                raise ValueError(f"{name} must be >= 0 (it is subtracted from the reward), got {weight!r}")

        self.shape = road_shape(scenario, int(lanes_count), LANE_WIDTH)
        self.scenario = scenario
        self.weathers = weather_choices(weather)
        self.vehicles_count, self.lanes_count = int(vehicles_count), int(lanes_count)
        self.traffic_speed = (float(traffic_speed[0]), float(traffic_speed[1]))
        self.max_episode_steps, self.initial_speed = max_episode_steps, float(initial_speed)
        self.steering_range, self.max_speed = float(steering_range), float(max_speed)
        self.steer_cost, self.brake_cost, self.crash_penalty = (
            float(steer_cost),
            float(brake_cost),
            float(crash_penalty),
        )
        self.sensors = VisionSensors(
            image_size=image_size,
            modalities=modalities,
            event=None if event is None else dict(event),
            depth=None if depth is None else dict(depth),
            shape=self.shape,
        )
        self._fixed_action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
        frequencies = {"simulation_frequency": simulation_frequency, "policy_frequency": policy_frequency}
        super().__init__(config=frequencies, render_mode=render_mode)

    # ---- spaces and sensors (hooks of AbstractEnv) ----

    def define_spaces(self) -> None:
        self.action_type = ContinuousAction(
            self,
            steering_range=(-self.steering_range, self.steering_range),
            speed_range=(0.0, self.max_speed),
        )
        self.action_space = self._fixed_action_space  # one object: `action_space.seed` outlives `reset`
        self.observation_type = VisionObservation(self)
        self.observation_space = self.observation_type.space()

    def update_metadata(self, video_real_time_ratio: float = 1) -> None:
        fps = video_real_time_ratio * self.config["policy_frequency"]
        self.metadata = {**type(self).metadata, "render_fps": fps}

    def _automatic_rendering(self) -> None:
        # AbstractEnv calls this after every simulation step of a control step but the last
        self._poses.append(self._snapshot())

    def _snapshot(self) -> np.ndarray:
        """Poses (N+1, 3) of the ego vehicle and the traffic: x [m], y [m], heading [rad]."""
        return np.array([(*v.position.tolist(), v.heading) for v in self.road.vehicles])

    def observe_sensors(self) -> dict[str, np.ndarray]:
        """What the sensors saw since the last observation; advances them, so called once per control step."""
        if self._elapsed_steps == 0:
            sizes = np.array([(v.LENGTH, v.WIDTH) for v in self.road.vehicles])
            seen = self.sensors.reset(self.weather, self._snapshot(), sizes, self._sensor_rng)
        else:
            poses = np.stack([*self._poses, self._snapshot()])
            seen = self.sensors.observe(poses, 1 / self.config["policy_frequency"], self._sensor_rng)
        self._observation: dict[str, np.ndarray] = seen
        return self._observation

    # ---- episodes ----

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode.

        :param seed: seeds everything random about this and all following episodes
        :param options: ``{"weather": ...}`` as in the constructor, for this episode only
        :raises ValueError: for other options or an unknown weather
        """
        unknown = set(options or {}) - {"weather"}
        if unknown:
            raise ValueError(f"unknown reset options {sorted(unknown)}; the only one is 'weather'")
        self._choices = weather_choices(options["weather"]) if options else self.weathers
        draws = self.action_space.np_random.bit_generator
        before = draws.state
        observation, info = super().reset(seed=seed)
        draws.state = before  # AbstractEnv.reset draws an action nobody uses, from the stream of whoever explores
        return observation, info

    def _reset(self) -> None:
        self._sensor_rng = np.random.default_rng(self.np_random.integers(2**63))
        self.weather = self._choices[self._sensor_rng.integers(len(self._choices))]
        plain = self.shape.plain
        network = HighwayNetwork(self.lanes_count) if plain else ShapedNetwork(self.shape)
        self.road = HighwayRoad(network, np_random=self.np_random)
        lane = int(self.np_random.integers(self.lanes_count - self.shape.oncoming))
        x = START_X if plain else START_X + self.np_random.uniform(0, PERIOD)
        ego = EgoVehicle.make_on_lane(self.road, (*FORWARD, lane), x, self.initial_speed)
        self.road.vehicles.append(ego)
        self.vehicle = ego
        traffic.populate(self.road, ego, self.vehicles_count, self.traffic_speed, self.np_random)
        self._elapsed_steps = 0
        self._distance = self._progress = 0.0
        self._poses: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Hold ``action`` for one control step.

        :param action: [throttle, steer], shape (2,), clipped to -1..1
        :raises ValueError: if the action has another shape or is not finite
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action must be two finite numbers [throttle, steer], got {action!r}")
        if self._elapsed_steps and (self._is_terminated() or self._is_truncated()):
            gym.logger.warn("step() called after the end of the episode; what it returns is undefined. Call reset().")
        traffic.recycle(self.road, self.vehicle, self.traffic_speed, self.np_random)
        self._poses = [self._snapshot()]
        self._elapsed_steps += 1
        return super().step(np.clip(action, -1.0, 1.0))  # type: ignore[no-any-return]

    def _simulate(self, action: np.ndarray | None = None) -> None:
        before = self.vehicle.position.copy()
        super()._simulate(action)
        dx, dy = (self.vehicle.position - before).tolist()
        ahead, aside = self.shape.direction(float(before[0]) + 0.5 * dx)
        self._progress = dx * ahead + dy * aside
        self._distance += self._progress

    def _reward(self, action: np.ndarray) -> float:
        throttle, steer = (float(a) for a in action)
        v_s: float = self._progress * self.config["policy_frequency"]
        reward = v_s / self.max_speed - self.steer_cost * abs(steer) - self.brake_cost * max(0.0, -throttle)
        return reward - self.crash_penalty * self._is_terminated()

    def _is_terminated(self) -> bool:
        return bool(self.vehicle.crashed or not self.vehicle.on_road)

    def _is_truncated(self) -> bool:
        return self.max_episode_steps is not None and self._elapsed_steps >= self.max_episode_steps

    def _info(self, obs: Any, action: np.ndarray | None = None) -> dict[str, Any]:
        crashed, offroad = bool(self.vehicle.crashed), not self.vehicle.on_road
        reasons = [("crash", crashed), ("offroad", offroad), ("timeout", self._is_truncated())]
        return {
            "distance": self._distance,
            "speed": float(self.vehicle.speed),
            "crashed": crashed,
            "offroad": bool(offroad),
            "weather": self.weather,
            "end_reason": next((reason for reason, holds in reasons if holds), None),
        }

    def render(self) -> np.ndarray | None:
        """The last observation as one uint8 picture (H, W, 3), its modalities side by side; None without a mode."""
        if self.render_mode is None:
            gym.logger.warn('render() needs render_mode="rgb_array", given to gym.make or the constructor.')
            return None
        return compose(self._observation, representation=self.sensors.representation)


class ReportTimeout(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Names gymnasium's own time limit in ``info["end_reason"]``.

    ``gym.make(id, max_episode_steps=n)`` never hands n to the env but wraps it in a TimeLimit; the registered env has
    no limit of its own, so that n can be anything, and this wrapper keeps the reason complete.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if truncated and info["end_reason"] is None:
            info["end_reason"] = "timeout"
        return observation, reward, terminated, truncated, info
