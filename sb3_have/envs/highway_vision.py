"""HighwayVision-v0: drive along a busy road, seen by an RGB camera, an event camera and a depth camera."""

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
from sb3_have.sensors.checks import check_whole, is_finite

# Lowest simulation frequency [Hz] at which no cars pass through each other head-on. highway-env looks one step of one
# car ahead; the other car, at 30 m/s, must not move farther in a step than both cars are long.
HEAD_ON_FREQUENCY = 3

# Position along the road at which the ego vehicle starts [m], far from both ends
START_X = 1000.0


class EgoVehicle(NeverReverses):
    """Car that the agent drives."""


class VisionObservation(ObservationType):
    """Observation of the sensors of a :class:`HighwayVisionEnv`. They belong to the environment and outlive resets."""

    def space(self) -> spaces.Dict:
        return spaces.Dict(self.env.sensors.spaces)

    def observe(self) -> dict[str, np.ndarray]:
        observation: dict[str, np.ndarray] = self.env.observe_sensors()
        return observation


class HighwayVisionEnv(AbstractEnv):
    """
    A road with traffic, continuous throttle and steering, and images as observations.

    Observation: a Dict of uint8 images (H, W, C): ``rgb`` (C=3), ``event`` (C=5 temporal bins of signed event counts,
    stored as 128 + count), ``depth`` (C=1, logarithmic). Action: ``Box(-1, 1, (2,))``, [throttle, steer]. Throttle is
    mapped to +-5 m/s^2; positive steer turns right. Reward per step::

        v_s / max_speed - steer_cost * abs(steer) - brake_cost * max(0, -throttle)
        - crash_penalty * (crashed or off road)

    where v_s is the mean speed along the road during the step [m/s]. A crash or leaving the road terminates the
    episode, ``max_episode_steps`` truncates it. ``info`` holds, after the reset and every step, ``distance`` (sum of
    v_s dt [m]), ``speed`` [m/s], ``crashed``, ``offroad``, ``weather`` and ``end_reason`` ("crash", "offroad",
    "timeout" or None).

    The traffic consists of highway-env's IDM/MOBIL drivers in a window that moves along (:mod:`sb3_have.envs.traffic`).
    The same seed gives the same bits. Traffic and sensors draw from separate generators, so that episodes with the same
    seed have the same traffic in any weather and with any modalities.

    Scenarios:

    - "highway": straight, with all lanes in one direction.
    - "merge": the same with an on-ramp from the right every 480 m. Its slow traffic speeds up on an acceleration lane
      of 180 m and cuts in where MOBIL considers it safe, accepting smaller gaps towards the end of the lane. The ego
      vehicle may also drive there.
    - "curves": a winding road, a sine with an amplitude of 12 m and a period of 480 m (radius 486 m and more; full lock
      of the default ``steering_range`` gives 250 m). Half of the lanes are for oncoming traffic, behind a double solid
      line. The ego vehicle may drive there, but the traffic only brakes for it and never changes sides.

    In "merge" and "curves" the ego vehicle starts at a random place of the period.

    All options are in ``env.config``, as in highway-env. ``env.unwrapped.configure({...})`` or changes to
    ``env.unwrapped.config`` take effect at the next reset, after the checks of the constructor; only the sensors and
    ``render_mode`` are fixed.

    :param weather: One of :data:`sb3_have.envs.weather.WEATHERS`, a list to draw from in each episode, or "random" for
        any of the eight. ``reset(options={"weather": ...})`` overrides it for one episode.
    :param modalities: Any of "rgb", "event" and "depth".
    :param image_size: Height and width of the images in pixels.
    :param vehicles_count: Number of other vehicles in the window of 440 m.
    :param traffic_speed: Range of the desired speeds of the traffic in m/s. The default is that of highway-env, 70 to
        80% of its limit of 30 m/s.
    :param lanes_count: Number of lanes, not counting ramps; even in "curves".
    :param max_episode_steps: Control steps per episode; None for no limit.
    :param initial_speed: Initial speed of the ego vehicle in m/s, 0 to ``max_speed``.
    :param simulation_frequency: Simulation steps per second, at least 3 in "curves". It is rounded up to a multiple of
        ``policy_frequency``.
    :param policy_frequency: Control steps per second.
    :param steering_range: Steering angle at full lock in rad.
    :param max_speed: Top speed of the ego vehicle in m/s. The car does not reverse.
    :param steer_cost: Weight of abs(steer) in the reward.
    :param brake_cost: Weight of braking in the reward.
    :param crash_penalty: Penalty for a crash or for leaving the road.
    :param event: Options of the event camera, see :class:`sb3_have.envs.vision.VisionSensors`.
    :param depth: Options of the depth camera, see :class:`sb3_have.envs.vision.VisionSensors`.
    :param render_mode: None or "rgb_array" (RGB, events and depth side by side).
    :param scenario: "highway", "merge" or "curves".
    :param duration: Length of an episode in seconds; takes precedence over ``max_episode_steps``. ``gym.make`` limits
        episodes to 500 steps (100 s) unless it is given a larger ``max_episode_steps``.
    :param config: Further options in a dict, as highway-env's environments accept them; they take precedence.
    :raises ValueError: If an option is unknown or out of range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012
    observation_space: spaces.Space[Any]
    sensors: VisionSensors
    road: HighwayRoad
    weather: str
    _elapsed_steps: int

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
        duration: float | None = None,
        config: Mapping[str, Any] | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        options = {
            "weather": weather,
            "vehicles_count": vehicles_count,
            "traffic_speed": traffic_speed,
            "lanes_count": lanes_count,
            "max_episode_steps": max_episode_steps,
            "initial_speed": initial_speed,
            "simulation_frequency": simulation_frequency,
            "policy_frequency": policy_frequency,
            "steering_range": steering_range,
            "max_speed": max_speed,
            "steer_cost": steer_cost,
            "brake_cost": brake_cost,
            "crash_penalty": crash_penalty,
            "scenario": scenario,
            "duration": duration,
        }
        sensors: dict[str, Any] = {"modalities": modalities, "image_size": image_size, "event": event, "depth": depth}
        given = dict(config or {})
        sensors |= {name: given.pop(name) for name in sensors if name in given}
        self._options, self._sensor_options = frozenset(options), sensors
        self._fixed_action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
        super().__init__(config={**options, **given}, render_mode=render_mode)

    # ---- configuration (hook of AbstractEnv) ----

    def configure(self, config: Mapping[str, Any] | None) -> None:
        """
        Change options from the next reset on.

        :param config: Options by name.
        :raises ValueError: If an option is unknown, fixed or out of range; the configuration then does not change.
        """
        config = config or {}
        self._check({**self.config, **config})
        self.config.update(config)
        # The first call comes from the constructor of AbstractEnv
        if not hasattr(self, "sensors"):
            self._apply()

    def _check(self, config: Mapping[str, Any]) -> None:
        # The configuration of AbstractEnv has more options, which have no effect here
        defaults = self.default_config()
        idle = {
            name: value
            for name, value in config.items()
            if name not in self._options and (name not in defaults or value != defaults[name])
        }
        if idle:
            raise ValueError(
                f"{sorted(idle)} cannot be configured: the options are {', '.join(sorted(self._options))} (the sensors "
                "are fixed when the environment is created)"
            )
        for name, least in [
            ("vehicles_count", 0),
            ("lanes_count", 1),
            ("policy_frequency", 1),
            ("simulation_frequency", 1),
        ]:
            check_whole(name, config[name], least)
        if config["max_episode_steps"] is not None:
            check_whole("max_episode_steps", config["max_episode_steps"], 1)
        frequency = config["policy_frequency"] * _sub_steps(config)
        if config["scenario"] == "curves" and frequency < HEAD_ON_FREQUENCY:
            raise ValueError(
                f"simulation_frequency must be >= {HEAD_ON_FREQUENCY} Hz in scenario 'curves', or cars would pass "
                f"through each other head-on; got {config['simulation_frequency']!r}"
            )
        for name in ("max_speed", "steering_range", "duration"):
            value = config[name]
            if not (is_finite(value) and value > 0) and not (name == "duration" and value is None):
                raise ValueError(f"{name} must be finite and positive, got {value!r}")
        for name in ("steer_cost", "brake_cost", "crash_penalty"):
            if not (is_finite(config[name]) and config[name] >= 0):
                raise ValueError(f"{name} must be >= 0 (it is subtracted from the reward), got {config[name]!r}")
        if not 0 <= config["initial_speed"] <= config["max_speed"]:
            raise ValueError(
                f"initial_speed must lie in 0..max_speed ({config['max_speed']} m/s), got {config['initial_speed']!r}"
            )
        speeds = config["traffic_speed"]
        if np.shape(speeds) != (2,) or not 0 < speeds[0] <= speeds[1] <= SPEED_LIMIT:
            raise ValueError(f"traffic_speed must be a range within 0..{SPEED_LIMIT} m/s, got {speeds!r}")
        road_shape(config["scenario"], config["lanes_count"], LANE_WIDTH)
        weather_choices(config["weather"])

    def _apply(self) -> None:
        """Adopt the configuration, which may also have been changed without :meth:`configure`."""
        config = self.config
        self._check(config)
        self.scenario = config["scenario"]
        self.shape = road_shape(self.scenario, int(config["lanes_count"]), LANE_WIDTH)
        self.weathers = weather_choices(config["weather"])
        self.vehicles_count, self.lanes_count = int(config["vehicles_count"]), int(config["lanes_count"])
        self.traffic_speed = (float(config["traffic_speed"][0]), float(config["traffic_speed"][1]))
        self.initial_speed, self.max_speed = float(config["initial_speed"]), float(config["max_speed"])
        self.steering_range = float(config["steering_range"])
        self.steer_cost, self.brake_cost = float(config["steer_cost"]), float(config["brake_cost"])
        self.crash_penalty = float(config["crash_penalty"])
        self.policy_frequency, self.sub_steps = int(config["policy_frequency"]), _sub_steps(config)
        self.max_episode_steps: int | None = config["max_episode_steps"]
        if config["duration"] is not None:
            self.max_episode_steps = max(1, round(config["duration"] * self.policy_frequency))
        if not hasattr(self, "sensors") or self.sensors.camera.shape != self.shape:
            self.sensors = VisionSensors(**self._sensor_options, shape=self.shape)

    # ---- spaces and sensors (hooks of AbstractEnv) ----

    def define_spaces(self) -> None:
        self.action_type = ContinuousAction(
            self,
            steering_range=(-self.steering_range, self.steering_range),
            speed_range=(0.0, self.max_speed),
        )
        # Keep the same object, so that its seed survives a reset
        self.action_space = self._fixed_action_space
        self.observation_type = VisionObservation(self)
        self.observation_space = self.observation_type.space()

    def update_metadata(self, video_real_time_ratio: float = 1) -> None:
        fps = video_real_time_ratio * self.policy_frequency
        self.metadata = {**type(self).metadata, "render_fps": fps}

    def _snapshot(self) -> np.ndarray:
        """Poses (N+1, 3) of the ego vehicle and the traffic: x [m], y [m], heading [rad]."""
        return np.array([(*v.position.tolist(), v.heading) for v in self.road.vehicles])

    def observe_sensors(self) -> dict[str, np.ndarray]:
        """Read the sensors. This advances them, so it is called once per control step."""
        if self._elapsed_steps == 0:
            sizes = np.array([(v.LENGTH, v.WIDTH) for v in self.road.vehicles])
            seen = self.sensors.reset(self.weather, self._snapshot(), sizes, self._sensor_rng)
        else:
            poses = np.stack([*self._poses, self._snapshot()])
            seen = self.sensors.observe(poses, 1 / self.policy_frequency, self._sensor_rng)
        self._observation: dict[str, np.ndarray] = seen
        return self._observation

    # ---- episodes ----

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """
        Start an episode.

        :param seed: Seed of everything random in this and all following episodes.
        :param options: ``{"weather": ...}`` as in the constructor, for this episode only.
        :raises ValueError: If another option is given, the weather is unknown, or the configuration is invalid.
        """
        unknown = set(options or {}) - {"weather"}
        if unknown:
            raise ValueError(f"unknown reset options {sorted(unknown)}; the only one is 'weather'")
        self._apply()
        self._choices = weather_choices(options["weather"]) if options else self.weathers
        draws = self.action_space.np_random.bit_generator
        before = draws.state
        observation, info = super().reset(seed=seed)
        # AbstractEnv.reset samples an unused action, which must not disturb exploration
        draws.state = before
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
        """
        Apply an action for one control step.

        :param action: [throttle, steer], shape (2,), clipped to -1..1.
        :raises ValueError: If the action has another shape or is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action must be two finite numbers [throttle, steer], got {action!r}")
        if self._elapsed_steps and (self._is_terminated() or self._is_truncated()):
            gym.logger.warn("step() was called after the end of the episode, so its result is undefined; call reset()")
        traffic.recycle(self.road, self.vehicle, self.traffic_speed, self.np_random)
        self._poses = [self._snapshot()]
        self._elapsed_steps += 1
        return super().step(np.clip(action, -1.0, 1.0))  # type: ignore[no-any-return]

    def _simulate(self, action: np.ndarray | None = None) -> None:
        # Like AbstractEnv._simulate, but with the frequencies that were valid at the reset
        before = self.vehicle.position.copy()
        self.action_type.act(action)
        for sub_step in range(self.sub_steps):
            self.road.act()
            self.road.step(1 / (self.policy_frequency * self.sub_steps))
            self.steps += 1
            # The last poses are those of the observation
            if sub_step < self.sub_steps - 1:
                self._poses.append(self._snapshot())
        # Progress along the road [m]
        dx, dy = (self.vehicle.position - before).tolist()
        ahead, aside = self.shape.direction(float(before[0]) + 0.5 * dx)
        self._progress = dx * ahead + dy * aside
        self._distance += self._progress

    def _reward(self, action: np.ndarray) -> float:
        throttle, steer = (float(a) for a in action)
        v_s = self._progress * self.policy_frequency
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
        """Return the last observation as a uint8 image (H, W, 3), modalities side by side; None without a mode."""
        if self.render_mode is None:
            gym.logger.warn('render() needs render_mode="rgb_array"; pass it to gym.make or the constructor')
            return None
        return compose(self._observation, representation=self.sensors.representation)


class ReportTimeout(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    Reports Gymnasium's time limit in ``info["end_reason"]``.

    ``gym.make(id, max_episode_steps=n)`` does not pass n to the environment but wraps it in a TimeLimit. The registered
    environment therefore has no limit of its own, and this wrapper adds the missing reason.

    :param env: Environment inside of a TimeLimit.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if truncated and info["end_reason"] is None:
            info["end_reason"] = "timeout"
        return observation, reward, terminated, truncated, info


def _sub_steps(config: Mapping[str, Any]) -> int:
    """Return the number of simulation steps per control step, rounded up so that no time is lost."""
    return -(-int(config["simulation_frequency"]) // int(config["policy_frequency"]))
