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
    Holds a run after ``STEPS`` steps of its process and says so by a file with the number of the process, in the folder
    that is named in the environment variable ``HELD``. A file "slowly" there lets the run go on slowly, and a file
    "freely" does not hold it at all.
    """

    def step(self, action: Any) -> Any:
        folder = Path(os.environ["HELD"])
        if next(counter) > STEPS and not (folder / "freely").exists():
            (folder / str(os.getpid())).touch()
            while not (folder / "slowly").exists():
                time.sleep(0.01)
            time.sleep(0.5)
        return super().step(action)
