"""What holds for all tests."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.wrappers import TimeLimit

TIME_LIMIT_PLACES: list[Any] = [gym.wrappers, gym.wrappers.common, gym.envs.registration]


@pytest.fixture(scope="module", autouse=True)
def gymnasium_time_limit() -> Iterator[None]:
    """rl_zoo3, once imported, puts a TimeLimit of its own into gymnasium; the next module's tests get gymnasium's."""
    yield
    for place in TIME_LIMIT_PLACES:
        place.TimeLimit = TimeLimit
