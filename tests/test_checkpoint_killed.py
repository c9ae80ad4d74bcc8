"""Training that is killed repeatedly loses nothing but the steps since its last checkpoint."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import killed_training
import numpy as np
import pytest
from killed_training import SAVE_FREQ, STEPS
from resuming import assert_same, everything

from sb3_have.checkpoint import checkpoint_step, checkpoints
from sb3_have.checkpoint.archive import damage

N_KILLS = 20


def moments(rng: np.random.Generator) -> list[tuple[str, float, int]]:
    """Draw how to die, at which number or part of the file, and count the checkpoints written by then."""
    found: list[tuple[str, float, int]] = []
    for i in range(N_KILLS):
        if i % 2 == 0:
            number = int(rng.integers(1, 40))
            found.append(("step", number, (number - 1) // SAVE_FREQ))
        elif i % 4 == 1:
            found.append(("byte", rng.random(), 0))
        else:
            moment, number = str(rng.choice(["before renaming", "after renaming"])), int(rng.integers(1, 3))
            found.append((moment, number, number - (moment == "before renaming")))
    return found


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills forks")
def test_killed_again_and_again(tmp_path: Path) -> None:
    expected = everything(killed_training.train(tmp_path / "unharmed", keep=STEPS))
    sizes = {checkpoint_step(path): path.stat().st_size for path in checkpoints(tmp_path / "unharmed")}
    folder, done = tmp_path / "killed", 0

    code = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import killed_training as k; k.serve()"
    server = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdin is not None and server.stdout is not None
    parts_written = []
    with server:
        for moment, number, written in moments(np.random.default_rng(5)):
            if moment == "byte":
                parts_written.append(number)
                number = 1 + int(number * (sizes[done + SAVE_FREQ] - 1))
            print(json.dumps([str(folder), moment, number]), file=server.stdin, flush=True)
            assert server.stdout.readline() == f"{signal.SIGKILL.value}\n", (moment, number, done)
            done += written * SAVE_FREQ
            assert max(map(checkpoint_step, checkpoints(folder)), default=0) == done < STEPS, moment
            for path in checkpoints(folder):
                assert damage(path) is None
            if moment == "byte":
                assert len([*folder.glob("*.partial")]) == 1
    assert min(parts_written) < 0.1 and max(parts_written) > 0.9
    assert done > STEPS // 2, "the deaths were at the beginning only"

    assert_same(everything(killed_training.train(folder)), expected)
    assert len([*folder.glob("checkpoint-*")]) == 2, "unfinished files are left"
