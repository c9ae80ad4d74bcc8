"""CarlaVision-v0: the highway of CARLA's Town04, seen through an RGB camera, an event camera and a depth camera."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_have.envs.carla_vision.rules import DEFAULTS, Plan, Reward, RewardForm, Trip
from sb3_have.envs.carla_vision.sensors import dvs_attributes, event_image, event_options
from sb3_have.envs.vision import MODALITIES, Observation, compose, depth_options
from sb3_have.envs.weather import weather_choices

if TYPE_CHECKING:
    from sb3_have.envs.carla_vision.episode import Episode
    from sb3_have.envs.carla_vision.session import Session

PAPER: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "modalities": ("rgb", "event"),
        "image_size": 128,
        "policy_frequency": 20,
        "max_episode_steps": 1000,
        "steering_range": None,
        "max_speed": 100.0,
        "traffic_speed": None,
        "reward": "paper",
        "offroad_ends": False,
    }
)
"""Options for the environment of the paper's experiments: 20 Hz control, the full steering lock, the default speeds of
the traffic manager, and episodes that end after 20 colliding ticks, at a standstill or after 1,000 steps. The paper has
no top speed; the car does not reach ``max_speed``, and the paper's reward does not depend on it."""


class CarlaVisionEnv(gym.Env[Observation, np.ndarray]):
    """
    A highway in CARLA with traffic, continuous throttle and steering, and image observations.

    Requires the package ``carla`` (extra ``carla``) and a running server. The environment connects to it at the first
    ``reset``, loads the map if the server has another one, and drives the server in synchronous mode. Every environment
    needs a server of its own, with its own ``port`` and ``tm_port``, and a process of its own (``SubprocVecEnv``):
    CARLA runs the traffic managers of all environments of a process at every tick of any of them. ``close``, an
    exception in ``reset`` or ``step``, and the end of the program remove all actors and restore the server's settings;
    the next ``reset`` connects again.

    Observations, actions and ``info`` are those of HighwayVision-v0
    (:class:`~sb3_have.envs.highway_vision.HighwayVisionEnv`), with "standstill" as an additional ``end_reason``. The
    ego vehicle starts on road 45 of Town04 in one of the lanes -1 to -4, at 100 to 110 m; the traffic starts in the
    same lanes at 114 to 300 m, at rest, and is driven by CARLA's traffic manager. The cameras sit 1 m ahead of and
    1.5 m above the car's centre and see 60 degrees. An episode terminates after ``collision_ticks`` simulation ticks
    with a collision ("crash"), when the car leaves the driving lanes ("offroad"), or after ``standstill_time`` without
    moving; it is truncated after ``max_episode_steps``. See :class:`~sb3_have.envs.carla_vision.rules.Reward` for the
    reward; ``distance`` is the sum of v_s dt.

    The same seed gives the same starting places, cars, colours, speeds and traffic manager seed. CARLA's physics and
    the noise of its event camera are not deterministic, so episodes do not repeat to the bit.

    A server may be restarted between episodes without traffic, or after ``close``. If it is lost with traffic on it,
    CARLA's traffic manager remains in this process as threads that cannot be stopped and abort it at the next tick
    (CARLA issues 4577, 6748, 7597), so ``reset`` and ``step`` raise an error until the process is restarted. All waits
    are limited by ``timeout``, except that a tick may hang in the traffic manager (issue 9172 in CARLA 0.9.16): let a
    watchdog outside of the process restart long training runs.

    This environment was written from CARLA's sources and tested on a simulated server; it has never run on a real one.
    Vehicles do not switch on their lights at night, and the RGB camera adapts its exposure.

    :param weather: Preset of ``carla.WeatherParameters``, a list to draw from each episode, or "random" for any of the
        eight in :data:`sb3_have.envs.weather.WEATHERS`
    :param modalities: Any of "rgb", "event", "depth"
    :param image_size: Height and width of the images [px]
    :param vehicles_count: Number of other vehicles; 0 also means no traffic manager
    :param traffic_speed: Range of the desired speeds of the other vehicles [m/s]; None leaves them to the traffic
        manager (70% of the speed limit), which may not drive faster than about 80 km/h (CARLA issue 6448)
    :param lanes_count: Number of lanes to place vehicles in, starting with the innermost
    :param max_episode_steps: Control steps per episode, or None for no limit
    :param initial_speed: Initial speed of the ego vehicle [m/s]. CARLA sets the speed but not the gear (issue 3710), so
        the car may lose some of it at first.
    :param simulation_frequency: Simulation ticks per second [Hz], at least 10 and a multiple of ``policy_frequency``
    :param policy_frequency: Control steps per second [Hz]
    :param steering_range: Angle of the front wheels at full steering [rad], or None for the vehicle's lock. The default
        is larger than in HighwayVision-v0 because the road bends and CARLA reduces the steering at speed.
    :param max_speed: Speed at which the throttle closes [m/s]; the car does not reverse
    :param steer_cost: Reward weight of steering
    :param brake_cost: Reward weight of braking
    :param crash_penalty: Penalty for a crash or leaving the road. Default: 0 with the paper's reward, 20 with
        HighwayVision-v0's
    :param event: ``bins``, ``representation``, ``threshold`` (one number or a pair for positive and negative events),
        ``threshold_sigma`` (CARLA draws the threshold again for every event), ``refractory`` [s], ``mapping`` ("log" or
        "identity"), ``log_eps`` and ``tau`` of the event camera, see
        :data:`~sb3_have.envs.carla_vision.sensors.EVENT_DEFAULTS`. A time surface only holds the events of the current
        control step, whatever ``tau`` is.
    :param depth: ``encoding`` and ``max`` as in HighwayVision-v0
    :param render_mode: None or "rgb_array" (RGB | event | depth side by side)
    :param scenario: Only "highway"; use ``town`` and ``road_id`` for other roads
    :param reward: "paper" or "highway" (the reward of HighwayVision-v0)
    :param collision_cost: Reward weight of the collision impulses [1/(N s)]. Default: 0.001 with the paper's reward, 0
        with HighwayVision-v0's
    :param collision_ticks: Number of simulation ticks with a collision that end an episode. Default: 20 with the
        paper's reward, 1 with HighwayVision-v0's
    :param standstill_time: Time below 0.1 m/s that ends an episode [s], which also applies at its start. Default: 5
        with the paper's reward, infinite with HighwayVision-v0's
    :param offroad_ends: Whether leaving the driving lanes ends an episode (it does not in the paper)
    :param host: Host of the server
    :param port: Port of the server
    :param tm_port: Port of the traffic manager, which runs in this process
    :param town: Name of the map
    :param road_id: OpenDRIVE id of the road to place vehicles on
    :param timeout: Longest time to wait for an answer of the server, a tick or an image [s]
    :param ego_vehicle: Blueprint of the ego vehicle
    :param event_grace: Longest time to wait for the events of a tick that has ended [s]. A tick without events sends
        nothing, so this time always passes when nothing moves; events that arrive later are dropped with a warning.
    :param take_over: Accept a server that is already in synchronous mode, and remove the actors that a client left
        there when it died
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (declared so by gymnasium)

    def __init__(
        self,
        weather: str | Sequence[str] = "random",
        modalities: Sequence[str] = MODALITIES,
        image_size: int = 84,
        vehicles_count: int = 20,
        traffic_speed: tuple[float, float] | None = (21.0, 24.0),
        lanes_count: int = 4,
        max_episode_steps: int | None = 500,
        initial_speed: float = 0.0,
        simulation_frequency: int = 20,
        policy_frequency: int = 5,
        steering_range: float | None = 0.1,
        max_speed: float = 30.0,
        steer_cost: float = 0.1,
        brake_cost: float = 0.1,
        crash_penalty: float | None = None,
        event: Mapping[str, Any] | None = None,
        depth: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        scenario: str = "highway",
        reward: RewardForm = "paper",
        collision_cost: float | None = None,
        collision_ticks: int | None = None,
        standstill_time: float | None = None,
        offroad_ends: bool = True,
        host: str = "localhost",
        port: int = 2000,
        tm_port: int = 8000,
        town: str = "Town04",
        road_id: int = 45,
        timeout: float = 10.0,
        ego_vehicle: str = "vehicle.tesla.model3",
        event_grace: float = 0.02,
        take_over: bool = False,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        if scenario != "highway":
            raise ValueError(f"CARLA has no scenario {scenario!r}; choose another road with `town` and `road_id`")
        if isinstance(modalities, str) or not modalities or not set(modalities) <= set(MODALITIES):
            raise ValueError(f"modalities must be a non-empty subset of {MODALITIES}, got {modalities!r}")
        if simulation_frequency % policy_frequency:
            raise ValueError(
                f"simulation_frequency ({simulation_frequency} Hz) must be a multiple of policy_frequency "
                f"({policy_frequency} Hz), otherwise control steps would be shorter"
            )
        if simulation_frequency < 10:
            raise ValueError(f"CARLA's physics require simulation_frequency >= 10 Hz, got {simulation_frequency}")
        if reward not in DEFAULTS:
            raise ValueError(f"reward must be one of {tuple(DEFAULTS)}, got {reward!r}")

        # Fill in the defaults that depend on the form of the reward
        default = DEFAULTS[reward]
        collision_cost = default["collision_cost"] if collision_cost is None else collision_cost
        crash_penalty = default["crash_penalty"] if crash_penalty is None else crash_penalty
        self.collision_ticks: int = default["collision_ticks"] if collision_ticks is None else collision_ticks
        self.standstill_time: float = default["standstill_time"] if standstill_time is None else standstill_time
        self._reward = Reward(reward, steer_cost, brake_cost, collision_cost, crash_penalty, max_speed)

        self.weathers = weather_choices(weather)
        self.modalities = tuple(name for name in MODALITIES if name in modalities)
        self.max_episode_steps = max_episode_steps
        self.offroad_ends = offroad_ends
        self._plan = Plan(
            modalities=self.modalities,
            image_size=image_size,
            event=event_options(event),
            event_grace=event_grace,
            depth=depth_options(depth),
            vehicles_count=vehicles_count,
            traffic_speed=traffic_speed,
            lanes_count=lanes_count,
            road_id=road_id,
            ego_vehicle=ego_vehicle,
            initial_speed=initial_speed,
            max_speed=max_speed,
            steering_range=steering_range,
        )
        self._server: dict[str, Any] = {
            "host": host,
            "port": port,
            "tm_port": tm_port,
            "town": town,
            "dt": 1 / simulation_frequency,
            "timeout": timeout,
            "traffic": vehicles_count > 0,
            "take_over": take_over,
        }
        self._dt: float = self._server["dt"]
        self._ticks = simulation_frequency // policy_frequency

        # Build the spaces; an empty event image also checks the options of the event camera before there is a server
        dvs_attributes(self._plan.event)
        size = image_size
        channels = {"rgb": 3, "event": event_image([], 0, 1.0, size, self._plan.event).shape[-1], "depth": 1}
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {name: spaces.Box(0, 255, (size, size, channels[name]), np.uint8) for name in self.modalities}
        )
        self.action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": policy_frequency}
        self._session: Session | None = None
        self._episode: Episode | None = None
        self._observation: Observation | None = None

    # ---- the server ----

    def _connect(self) -> Session:
        if self._session is not None and not self._session.usable():
            self.close()  # the server was restarted or has loaded another world since the last episode
        if self._session is None:
            try:
                from sb3_have.envs.carla_vision.session import Session
            except ImportError as error:
                if error.name != "carla":
                    raise
                raise ImportError(
                    "CarlaVision-v0 requires the package carla: pip install 'sb3_have[carla]'. It is available for "
                    "Python 3.10 to 3.12 on 64-bit Linux and Windows",
                    name="carla",
                ) from error
            self._session = Session(**self._server)
            # Clean up when the environment is garbage collected or the program ends, too
            self._finalizer = weakref.finalize(self, self._session.close)
            self._session.connect()
        return self._session

    @contextmanager
    def _clean_up_on_error(self) -> Iterator[None]:
        """Close the session on any exception, including Ctrl-C, and find out the cause of a timeout."""
        try:
            yield
        except BaseException as error:
            session = self._session
            self.close()
            if session is not None and isinstance(error, RuntimeError | TimeoutError):
                if session.lost:
                    raise session.connection_error("lost the CARLA server at") from error
                if "time-out" in str(error):
                    raise TimeoutError(
                        f"the CARLA server is alive but did not answer within {session.timeout} s; increase `timeout`"
                    ) from error
            raise

    def close(self) -> None:
        """Remove everything from the server and disconnect. The next ``reset`` connects again."""
        self._episode = None
        if self._session is not None:
            self._session.close()
            self._finalizer.detach()
            self._session = None

    # ---- episodes ----

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """
        Start an episode; connect to the server if necessary.

        :param seed: Seed for everything random in this and all following episodes
        :param options: ``{"weather": ...}`` as in the constructor, for this episode only
        :return: The first observation and info
        :raises ValueError: If an option is unknown, or the map does not have the road or the lanes
        :raises ConnectionError: If there is no server, or this process lost one with traffic
        :raises TimeoutError: If the server is alive but too slow
        :raises RuntimeError: If another client drives the server, there is no room for the cars, or a sensor failed
        """
        if unknown := set(options or {}) - {"weather"}:
            raise ValueError(f"unknown reset options {sorted(unknown)}; the only one is 'weather'")
        choices = weather_choices(options["weather"]) if options else self.weathers
        super().reset(seed=seed)
        # Separate generators, so that the traffic does not depend on the choice of weathers
        weather_rng, rng = (np.random.default_rng(draw) for draw in self.np_random.integers(2**63, size=2))
        self.weather = choices[weather_rng.integers(len(choices))]
        self._trip, self._steps = Trip(), 0
        with self._clean_up_on_error():
            session = self._connect()
            from sb3_have.envs.carla_vision.episode import Episode

            self._episode = Episode(session, self._plan, self.weather, rng)
            self._observation = self._episode.observe(0)
        return self._observation, self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """
        Apply an action for one control step.

        :param action: [throttle, steer], shape (2,), clipped to -1..1; negative throttle brakes, positive steer turns
            right
        :return: Observation, reward, terminated, truncated and info
        :raises ValueError: If the action has another shape or is not finite
        :raises gymnasium.error.ResetNeeded: Before ``reset``, and after an exception
        :raises ConnectionError: If the server is gone
        :raises TimeoutError: If the server is alive but too slow
        :raises RuntimeError: If a sensor failed
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action must be two finite numbers [throttle, steer], got {action!r}")
        if self._episode is None:
            raise gym.error.ResetNeeded("there is no episode; call reset() first, and again after an error")
        if self._end_reason() is not None:
            gym.logger.warn("step() was called after the end of the episode, so its result is undefined; call reset()")

        # Advance the simulation and read the sensors
        throttle, steer = (float(value) for value in np.clip(action, -1.0, 1.0))
        with self._clean_up_on_error():
            lanes = [self._episode.tick(throttle, steer) for _ in range(self._ticks)]
            self._observation = self._episode.observe(self._ticks)
            collisions, impulse = self._episode.collisions()

        # Update the running totals
        for lane in lanes:
            self._trip.tick(lane.lane_speed, lane.speed, self._dt, lane.offroad)
        self._trip.collisions += collisions
        self._steps += 1

        # Compute reward and end of the episode
        reason = self._end_reason()
        speeds = [lane.lane_speed for lane in lanes]
        reward = self._reward(speeds, self._dt, throttle, steer, impulse, reason in ("crash", "offroad"))
        return self._observation, reward, reason not in (None, "timeout"), self._out_of_time(), self._info()

    def _crashed(self) -> bool:
        return self._trip.collisions >= self.collision_ticks

    def _out_of_time(self) -> bool:
        return self.max_episode_steps is not None and self._steps >= self.max_episode_steps

    def _end_reason(self) -> str | None:
        if self._crashed():
            return "crash"
        if self.offroad_ends and self._trip.offroad:
            return "offroad"
        if self._trip.stuck(self.standstill_time):
            return "standstill"
        return "timeout" if self._out_of_time() else None

    def _info(self) -> dict[str, Any]:
        assert self._episode is not None
        return {
            "distance": self._trip.distance,
            "speed": self._episode.lane.speed,
            "crashed": self._crashed(),
            "offroad": self._trip.offroad,
            "weather": self.weather,
            "end_reason": self._end_reason(),
        }

    def render(self) -> np.ndarray | None:
        """Render the last observation as one uint8 image (H, W, 3) with the modalities side by side."""
        if self.render_mode is None:
            gym.logger.warn('render() requires render_mode="rgb_array" in gym.make or the constructor')
            return None
        if self._observation is None:
            raise gym.error.ResetNeeded("there is nothing to render yet; call reset() first")
        return compose(self._observation, representation=self._plan.event["representation"])
