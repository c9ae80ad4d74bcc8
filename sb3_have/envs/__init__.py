"""
Driving environments, registered on import: HighwayVision-v0, CarlaVision-v0 and ReliabilityDrive-v0; and RuleDriven-v0,
HighwayVision-v0 with the driver of highway-env, for comparison.

What belongs here simulates or connects to a world, and drives in it by rule; nothing here imports torch. Sensors that
work with any environment belong to :mod:`sb3_have.sensors`.
"""

from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import WrapperSpec, register, registry

if TYPE_CHECKING:
    from sb3_have.envs.highway_vision import HighwayVisionEnv
    from sb3_have.envs.reliability_drive import ReliabilityDriveEnv

__all__ = ["HighwayVisionEnv", "ReliabilityDriveEnv"]

# Entry points are strings, so that highway-env is imported with the first environment, and the optional package carla
# only for CarlaVision-v0
for name, entry_point in {
    "HighwayVision-v0": "highway_vision:HighwayVisionEnv",
    "RuleDriven-v0": "rule_driven:RuleDrivenEnv",
    "CarlaVision-v0": "carla_vision:CarlaVisionEnv",
}.items():
    if name not in registry:
        register(
            id=name,
            entry_point=f"sb3_have.envs.{entry_point}",
            max_episode_steps=500,
            kwargs={"max_episode_steps": None},  # Gymnasium counts the steps, see ReportTimeout
            additional_wrappers=(WrapperSpec("ReportTimeout", "sb3_have.envs.highway_vision:ReportTimeout", {}),),
        )

if "ReliabilityDrive-v0" not in registry:
    register(id="ReliabilityDrive-v0", entry_point="sb3_have.envs.reliability_drive:ReliabilityDriveEnv")


def __getattr__(name: str) -> Any:
    """Import an environment class on first use (PEP 562)."""
    if name == "HighwayVisionEnv":
        from sb3_have.envs.highway_vision import HighwayVisionEnv

        return HighwayVisionEnv
    if name == "ReliabilityDriveEnv":
        from sb3_have.envs.reliability_drive import ReliabilityDriveEnv

        return ReliabilityDriveEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
