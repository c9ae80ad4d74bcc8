"""A wrapper that holds a run, so that a test can interfere with it."""

import itertools
import os
import time
from pathlib import Path
from typing import Any

import gymnasium as gym

STEPS = 25
# Not an attribute of the wrapper, which a checkpoint would restore
counter = itertools.count(1)


class Held(gym.Wrapper[Any, Any, Any, Any]):
    """
    Holds a run after ``STEPS`` steps of its process and creates a file named after its process ID in the folder
    ``$HELD``. A file "slowly" there lets the run continue slowly; a file "freely" turns holding off.
    """

    def step(self, action: Any) -> Any:
        folder = Path(os.environ["HELD"])
        if next(counter) > STEPS and not (folder / "freely").exists():
            (folder / str(os.getpid())).touch()
            while not (folder / "slowly").exists():
                time.sleep(0.01)
            time.sleep(2)
        return super().step(action)
