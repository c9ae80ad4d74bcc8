"""A wrapper that gives a test time to interfere with a run."""

import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym


class SlowUntil(gym.Wrapper[Any, Any, Any, Any]):
    """Slows every step down until the file named in the environment variable ``HURRY`` exists."""

    def step(self, action: Any) -> Any:
        if not Path(os.environ["HURRY"]).exists():
            time.sleep(0.1)
        return super().step(action)
