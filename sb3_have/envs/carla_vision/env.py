"""CarlaVision-v0: the highway of Town04 in CARLA, seen through an RGB camera, an event camera and a depth camera."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_have.envs.carla_vision.rules import COLLISION_TICKS, STANDSTILL_TIME, Plan, Reward, RewardForm, Server, Trip
from sb3_have.envs.carla_vision.sensors import dvs_attributes, event_image, event_options
from sb3_have.envs.vision import MODALITIES, Observation, compose, depth_options
from sb3_have.envs.weather import weather_choices
from sb3_have.sensors.checks import check_whole, is_finite, is_number, is_pair

if TYPE_CHECKING:
    from sb3_have.envs.carla_vision.episode import Episode
    from sb3_have.envs.carla_vision.session import Session

#: The greatest number of a port.
PORTS: Final = 65535
#: Options that make ``CarlaVision-v0`` the environment of the paper's experiments: 20 Hz control, the full lock,
#: traffic at the traffic manager's own speeds, ends by 20 colliding ticks, standstill or 1,000 steps only. The paper
#: has no top speed: ``max_speed`` is beyond what the car reaches, and its reward does not look at it.
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


class CarlaVisionEnv(gym.Env[Observation, np.ndarray]):
    """A highway in CARLA with traffic, continuous throttle and steering, and images for observations.

    Needs the package ``carla`` (extra ``carla``) and a running server, which it connects to at the first ``reset``. The
    server is put into synchronous mode and driven by this environment alone. ``close``, any exception out of ``reset``
    or ``step``, and the end of the program remove what was put there and restore the server's settings; the next
    ``reset`` connects anew. The map is loaded only if the server has another one.

    Every environment needs a server, and with it ``port`` and ``tm_port``, of its own; a second one on the same server
    is refused. Let each have a process of its own, too (``SubprocVecEnv``): CARLA runs the traffic managers of all
    environments of a process at every tick of any of them.

    A server may be restarted between episodes without traffic, and with traffic after ``close``. One that is lost with
    traffic on it leaves CARLA's traffic manager behind, threads of this process that nothing can stop and that abort
    it at the next tick (CARLA's issues 4577, 6748, 7597): from then on ``reset`` and ``step`` raise until the process
    is restarted. ``timeout`` bounds all waits for answers and images, but a tick may hang for ever inside the traffic
    manager (issue 9172, in CARLA 0.9.16): have a watchdog outside of the process restart long trainings.

    Observation, action and ``info`` are those of HighwayVision-v0
    (:class:`~sb3_have.envs.highway_vision.HighwayVisionEnv`), with ``end_reason`` "standstill" besides. The ego starts
    on road 45 of Town04, in one of the lanes -1 to -4 at 100 to 110 m, the traffic in those lanes at 114 to 300 m, all
    at rest; CARLA's traffic manager drives it. The camera sits 1 m ahead of and 1.5 m above the car's centre and sees
    60 degrees. An episode is terminated by ``collision_ticks`` simulation ticks with a collision in all ("crash"), by
    leaving the driving lanes ("offroad", see ``offroad_ends``) and after ``standstill_time`` without moving;
    ``max_episode_steps`` truncates it. ``distance`` is the sum of v_s dt. The reward is
    :class:`~sb3_have.envs.carla_vision.rules.Reward`.

    The same seed gives the same places, cars, colours, speeds and seed of the traffic manager. CARLA's physics and the
    noise of its event camera are its own: whole episodes do not repeat to the bit.

    What only a live server can show was not seen: this was written against CARLA's sources and a simulated server. At
    night no vehicle's lights are switched on here, and the RGB camera's exposure adapts by itself.

    Options that HighwayVision-v0 has too:

    :param weather: as there; presets of ``carla.WeatherParameters``
    :param modalities: any of "rgb", "event", "depth"
    :param image_size: height and width of the images [px]
    :param vehicles_count: other vehicles; without any there is no traffic manager either
    :param traffic_speed: range of the speeds the others want to drive at [m/s]; None leaves it to the traffic manager
        (70% of the limit), which may also keep them below some 80 km/h (CARLA's issue 6448)
    :param lanes_count: lanes that cars are put in, from the innermost
    :param max_episode_steps: control steps per episode, or None for no limit
    :param initial_speed: of the ego vehicle [m/s], in 0 to ``max_speed``. CARLA sets the speed and not the gear
        (issue 3710), so the car may lose some of it before it pulls
    :param simulation_frequency: [Hz], at least 10 (CARLA's physics) and a multiple of ``policy_frequency``
    :param policy_frequency: control steps per second [Hz]
    :param steering_range: angle of the front wheels at full steering [rad]; None for the vehicle's lock, as in the
        paper. More than in HighwayVision-v0 by default: the road bends, and CARLA steers less at speed
    :param max_speed: the throttle closes at this speed [m/s]; the car does not reverse. The paper has no such limit,
        see :data:`PAPER`
    :param steer_cost: reward weight
    :param brake_cost: reward weight
    :param crash_penalty: reward weight; None: 0 with the paper's reward, 20 with HighwayVision's
    :param event: ``bins``, ``representation``, ``threshold`` (one or a pair: positive, negative), ``threshold_sigma``
        (CARLA draws it anew for every event), ``refractory`` [s], ``mapping`` ("log", "identity"), ``log_eps`` and
        ``tau`` of the event camera, see :data:`~sb3_have.envs.carla_vision.sensors.EVENT_DEFAULTS`. A time surface
        holds the events of the current control step only, whatever ``tau``
    :param depth: ``encoding`` and ``max`` as in HighwayVision-v0
    :param render_mode: None or "rgb_array" (RGB | event | depth side by side)
    :param scenario: "highway"; for other roads choose ``town`` and ``road_id``

    and those of its own:

    :param reward: "paper" or "highway"
    :param collision_cost: reward weight, per N s; None: 0.001 with the paper's reward, 0 with HighwayVision's
    :param collision_ticks: simulation ticks with a collision that end an episode; None: 20 with the paper's reward, 1
        with HighwayVision's
    :param standstill_time: seconds below 0.1 m/s in a row that end an episode, also at its start; infinite: never;
        None: 5 with the paper's reward, never with HighwayVision's
    :param offroad_ends: whether leaving the driving lanes ends an episode; not so in the paper
    :param host: of the server
    :param port: of the server
    :param tm_port: of the traffic manager, in this process
    :param town: name of the map
    :param road_id: OpenDRIVE id of the road that cars are put on
    :param timeout: for an answer of the server, a tick or an image [s]
    :param ego_vehicle: blueprint of the ego
    :param event_grace: how long to wait for the events of a tick that has ended [s]. One without events sends nothing,
        so this passes whenever nothing moves; events that come later are dropped, with a warning the first time
    :param take_over: drive a server that is in synchronous mode already, and remove what a client that died left there
    :raises ValueError: for any option outside of what is stated here
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
            raise ValueError(f"CARLA has no scenario {scenario!r}; choose another road by `town` and `road_id`")
        if isinstance(modalities, str) or not modalities or not set(modalities) <= set(MODALITIES):
            raise ValueError(f"modalities must be a non-empty subset of {MODALITIES}, got {modalities!r}")
        whole: list[tuple[str, Any, int, int | None]] = [
            ("image_size", image_size, 16, None),
            ("vehicles_count", vehicles_count, 0, None),
            ("lanes_count", lanes_count, 1, None),
            ("max_episode_steps", 1 if max_episode_steps is None else max_episode_steps, 1, None),
            ("policy_frequency", policy_frequency, 1, None),
            ("simulation_frequency", simulation_frequency, 10, None),
            ("collision_ticks", 1 if collision_ticks is None else collision_ticks, 1, None),
            ("port", port, 1, PORTS),
            ("tm_port", tm_port, 1024, PORTS),
            ("road_id", road_id, 0, None),
        ]
        for name, value, least, most in whole:
            check_whole(name, value, least, most)
        if simulation_frequency % policy_frequency:
            raise ValueError(
                f"simulation_frequency ({simulation_frequency} Hz) must be a multiple of "
                f"policy_frequency ({policy_frequency} Hz), or control steps would lose time"
            )
        for name, positive in [
            ("timeout", timeout),
            ("steering_range", 1.0 if steering_range is None else steering_range),
        ]:
            if not (is_finite(positive) and positive > 0):
                raise ValueError(f"{name} must be a positive number, got {positive!r}")
        if standstill_time is not None and not (is_number(standstill_time) and standstill_time > 0):
            raise ValueError(f"standstill_time must be a positive number, got {standstill_time!r}")
        if not (is_finite(event_grace) and event_grace >= 0):
            raise ValueError(f"event_grace must be a number >= 0, got {event_grace!r}")
        if traffic_speed is not None and not (is_pair(traffic_speed) and 0 < traffic_speed[0] <= traffic_speed[1]):
            raise ValueError(
                f"traffic_speed must be None or (least, greatest), positive and finite [m/s], got {traffic_speed!r}"
            )
        self._reward = Reward(reward, steer_cost, brake_cost, collision_cost, crash_penalty, max_speed)
        if not is_finite(initial_speed) or not 0 <= initial_speed <= max_speed:
            raise ValueError(f"initial_speed must be a number in 0..max_speed ({max_speed} m/s), got {initial_speed!r}")
        self.weathers = weather_choices(weather)
        self.modalities = tuple(name for name in MODALITIES if name in modalities)
        self.max_episode_steps = max_episode_steps
        self.collision_ticks = COLLISION_TICKS[reward] if collision_ticks is None else int(collision_ticks)
        self.standstill_time = STANDSTILL_TIME[reward] if standstill_time is None else float(standstill_time)
        self.offroad_ends = bool(offroad_ends)
        self._event, self._depth = event_options(event), depth_options(depth)
        dvs_attributes(self._event)  # complains about a wrong option now, not at reset
        size = int(image_size)
        no_events = event_image([], 0, 1.0, size, self._event)  # complains, too
        self._plan = Plan(
            modalities=self.modalities,
            image_size=size,
            event=self._event,
            event_grace=float(event_grace),
            depth=self._depth,
            vehicles_count=int(vehicles_count),
            traffic_speed=None if traffic_speed is None else (float(traffic_speed[0]), float(traffic_speed[1])),
            lanes_count=int(lanes_count),
            road_id=int(road_id),
            ego_vehicle=ego_vehicle,
            initial_speed=float(initial_speed),
            max_speed=float(max_speed),
            steering_range=None if steering_range is None else float(steering_range),
        )
        self._server = Server(
            host=host,
            port=int(port),
            tm_port=int(tm_port),
            town=town,
            tick=1 / int(simulation_frequency),
            timeout=float(timeout),
            traffic=vehicles_count > 0,
            take_over=bool(take_over),
        )
        self._ticks = int(simulation_frequency // policy_frequency)
        depths = {"rgb": 3, "event": no_events.shape[-1], "depth": 1}
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {name: spaces.Box(0, 255, (size, size, depths[name]), np.uint8) for name in self.modalities}
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
            self.close()  # the server was restarted, or loaded another world, since the last episode
        if self._session is not None:
            return self._session
        try:
            from sb3_have.envs.carla_vision.session import Session
        except ImportError as error:
            if error.name != "carla":
                raise
            raise ImportError(
                "CarlaVision-v0 needs the package carla: pip install 'sb3_have[carla]'. It exists for Python 3.10 to "
                "3.12 on 64-bit Linux and Windows",
                name="carla",
            ) from error
        session = self._session = Session(self._server)
        # also when the environment is collected, or the program ends
        self._finalizer = weakref.finalize(self, session.close)
        session.connect()
        return session

    @contextmanager
    def _cleaning_up(self) -> Iterator[None]:
        """Whatever goes wrong, Ctrl-C included, leaves nothing on the server; a time-out is told apart by its cause."""
        try:
            yield
        except BaseException as error:
            session = self._session
            self.close()
            if session is None or not isinstance(error, RuntimeError | TimeoutError):
                raise
            if session.lost:
                raise session.connection_error("lost the CARLA server at") from error
            if isinstance(error, RuntimeError) and "time-out" in str(error):
                raise TimeoutError(
                    f"the CARLA server is alive but did not finish within {session.server.timeout} s; raise `timeout`"
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
        Start an episode; connect to the server if there is no connection.

        :param seed: seeds everything random about this and all following episodes
        :param options: ``{"weather": ...}`` as in the constructor, for this episode only
        :raises ValueError: for other options, an unknown weather, or a map without the road or the lanes asked for
        :raises ConnectionError: if there is no server, or the process has lost one with traffic
        :raises TimeoutError: if the server is alive and too slow
        :raises RuntimeError: if somebody else drives the server, there is no room for the cars, or a sensor failed
        """
        unknown = set(options or {}) - {"weather"}
        if unknown:
            raise ValueError(f"unknown reset options {sorted(unknown)}; the only one is 'weather'")
        choices = weather_choices(options["weather"]) if options else self.weathers
        super().reset(seed=seed)
        # A generator each: the traffic does not depend on the choice of weathers.
        weather_rng, rng = (np.random.default_rng(draw) for draw in self.np_random.integers(2**63, size=2))
        self.weather = choices[weather_rng.integers(len(choices))]
        self._trip, self._steps = Trip(), 0
        with self._cleaning_up():
            session = self._connect()
            from sb3_have.envs.carla_vision.episode import Episode

            self._episode = Episode(session, self._plan, self.weather, rng)
            self._observation = self._episode.first_observation()
        return self._observation, self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """
        Hold ``action`` for one control step.

        :param action: [throttle, steer], shape (2,), clipped to -1..1; throttle below 0 brakes, steer above 0 goes
            right
        :raises ValueError: if the action has another shape or is not finite
        :raises gymnasium.error.ResetNeeded: before ``reset``, and after an exception
        :raises ConnectionError: if the server has gone
        :raises TimeoutError: if the server is alive and too slow
        :raises RuntimeError: if a sensor failed
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action must be two finite numbers [throttle, steer], got {action!r}")
        if self._episode is None:
            raise gym.error.ResetNeeded("there is no episode (nor a connection after an error): call reset()")
        if self._end_reason() is not None:
            gym.logger.warn("step() called after the end of the episode; what it returns is undefined. Call reset().")
        throttle, steer = (float(part) for part in np.clip(action, -1.0, 1.0))
        dt: float = self._server.tick
        with self._cleaning_up():
            lanes = [self._episode.tick(throttle, steer) for _ in range(self._ticks)]
            self._observation = self._episode.observation(self._ticks)
            collisions = self._episode.collisions()
        for lane in lanes:
            self._trip = self._trip.tick(lane.lane_speed, lane.speed, dt, lane.offroad)
        self._trip = self._trip.collide(collisions.ticks)
        self._steps += 1
        reason = self._end_reason()
        speeds = [lane.lane_speed for lane in lanes]
        reward = self._reward(speeds, dt, throttle, steer, collisions.impulse, reason in ("crash", "offroad"))
        truncated = self.max_episode_steps is not None and self._steps >= self.max_episode_steps
        return self._observation, reward, reason not in (None, "timeout"), truncated, self._info()

    def _end_reason(self) -> str | None:
        reasons = [
            ("crash", self._trip.crashed(self.collision_ticks)),
            ("offroad", self.offroad_ends and self._trip.offroad),
            ("standstill", self._trip.stuck(self.standstill_time)),
            ("timeout", self.max_episode_steps is not None and self._steps >= self.max_episode_steps),
        ]
        return next((reason for reason, holds in reasons if holds), None)

    def _info(self) -> dict[str, Any]:
        assert self._episode is not None
        return {
            "distance": self._trip.distance,
            "speed": self._episode.lane.speed,
            "crashed": self._trip.crashed(self.collision_ticks),
            "offroad": self._trip.offroad,
            "weather": self.weather,
            "end_reason": self._end_reason(),
        }

    def render(self) -> np.ndarray | None:
        """The last observation as one uint8 picture (H, W, 3), its modalities side by side; None without a mode."""
        if self.render_mode is None:
            gym.logger.warn('render() needs render_mode="rgb_array", given to gym.make or the constructor.')
            return None
        if self._observation is None:
            raise gym.error.ResetNeeded("nothing to render yet: call reset()")
        return compose(self._observation, representation=self._event["representation"])
