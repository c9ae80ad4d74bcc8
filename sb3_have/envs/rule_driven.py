"""RuleDriven-v0: HighwayVision-v0 driven by highway-env's own driver (IDM/MOBIL), which knows where the traffic is."""

from highway_env.vehicle.behavior import IDMVehicle

from sb3_have.envs.highway_vision import HighwayVisionEnv


class RuleDrivenEnv(HighwayVisionEnv):
    """
    ``HighwayVision-v0`` driven by highway-env's IDM/MOBIL driver. Actions are ignored.

    :param kwargs: As for :class:`~sb3_have.envs.highway_vision.HighwayVisionEnv`
    """

    def _reset(self) -> None:
        super()._reset()
        ego = self.vehicle
        self.vehicle = IDMVehicle(self.road, ego.position, ego.heading, ego.speed, target_speed=self.max_speed)
        self.road.vehicles[0] = self.vehicle
