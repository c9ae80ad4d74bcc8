"""Environments; importing this package registers them: HighwayVision-v0, CarlaVision-v0 and ReliabilityDrive-v0."""

from gymnasium.envs.registration import WrapperSpec, register, registry

from sb3_have.envs.highway_vision import HighwayVisionEnv
from sb3_have.envs.reliability_drive import ReliabilityDriveEnv

__all__ = ["HighwayVisionEnv", "ReliabilityDriveEnv"]

if "HighwayVision-v0" not in registry:
    register(
        id="HighwayVision-v0",
        entry_point="sb3_have.envs.highway_vision:HighwayVisionEnv",
        max_episode_steps=500,
        kwargs={"max_episode_steps": None},  # gymnasium counts, see ReportTimeout
        additional_wrappers=(WrapperSpec("ReportTimeout", "sb3_have.envs.highway_vision:ReportTimeout", {}),),
    )

if "CarlaVision-v0" not in registry:
    register(
        id="CarlaVision-v0",
        entry_point="sb3_have.envs.carla_vision:CarlaVisionEnv",  # by name: the package carla is an extra
        max_episode_steps=500,
        kwargs={"max_episode_steps": None},
        additional_wrappers=(WrapperSpec("ReportTimeout", "sb3_have.envs.highway_vision:ReportTimeout", {}),),
    )

if "ReliabilityDrive-v0" not in registry:
    register(id="ReliabilityDrive-v0", entry_point="sb3_have.envs.reliability_drive:ReliabilityDriveEnv")
