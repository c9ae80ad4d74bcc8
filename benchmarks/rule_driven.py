"""HighwayVision-v0 with highway-env's own driver at the wheel, for what needs a car that gets somewhere."""

from highway_env.vehicle.behavior import IDMVehicle

from sb3_have.envs import HighwayVisionEnv


class RuleDrivenEnv(HighwayVisionEnv):
    """An IDM/MOBIL driver at the wheel, whatever the action."""

    def _reset(self) -> None:
        super()._reset()
        ego = self.vehicle
        self.vehicle = IDMVehicle(self.road, ego.position, ego.heading, ego.speed, target_speed=self.max_speed)
        self.road.vehicles[0] = self.vehicle
