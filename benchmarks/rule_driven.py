"""HighwayVision-v0 driven by highway-env's IDM/MOBIL driver."""

from highway_env.vehicle.behavior import IDMVehicle

from sb3_have.envs import HighwayVisionEnv


class RuleDrivenEnv(HighwayVisionEnv):
    """HighwayVision-v0 driven by IDM/MOBIL; actions are ignored."""

    def _reset(self) -> None:
        super()._reset()
        ego = self.vehicle
        self.vehicle = IDMVehicle(self.road, ego.position, ego.heading, ego.speed, target_speed=self.max_speed)
        self.road.vehicles[0] = self.vehicle
