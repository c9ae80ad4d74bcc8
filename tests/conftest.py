"""What holds for all tests."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.wrappers import TimeLimit
from hypothesis import HealthCheck, settings

# No test may depend on how busy the machine is
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

TIME_LIMIT_PLACES: list[Any] = [gym.wrappers, gym.wrappers.common, gym.envs.registration]


@pytest.fixture(scope="module", autouse=True)
def gymnasium_time_limit() -> Iterator[None]:
    """rl_zoo3, once imported, puts a TimeLimit of its own into gymnasium; the next module's tests get gymnasium's."""
    yield
    for place in TIME_LIMIT_PLACES:
        place.TimeLimit = TimeLimit
