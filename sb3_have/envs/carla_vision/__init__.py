"""CarlaVision-v0, the paper's environment on the CARLA simulator. Importing it does not import ``carla``."""

from sb3_have.envs.carla_vision.env import PAPER, CarlaVisionEnv
from sb3_have.envs.carla_vision.rules import CarlaConnectionError

__all__ = ["PAPER", "CarlaConnectionError", "CarlaVisionEnv"]
