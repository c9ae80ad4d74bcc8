"""The peers of the speed tables: a bare loop that does learn, and rows for everybody."""

import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces

from benchmarks import peers, update_speed


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(update_speed, "BUFFER_SIZE", 8)
    monkeypatch.setattr(peers, "BUFFER_SIZE", 8)
    monkeypatch.setattr(peers, "LEARN_STEPS", 2)


def test_the_bare_loop_learns() -> None:
    """The reward of a single step is the first action: the critic finds it, and the actor follows."""
    th.manual_seed(0)
    loop = peers.BareLoop(spaces.Box(0, 255, (3, 36, 36), np.uint8), 2, batch_size=32, device="cpu")
    images = np.random.default_rng(0).integers(256, size=(1, 3, 36, 36)).astype(np.uint8)
    for first in np.linspace(-1, 1, 8):
        loop.store(images, images, np.array([[first, 0.0]]), [5 * first], [1.0])
    before = np.mean([loop.act(images)[0, 0] for _ in range(50)])
    for _ in range(200):
        loop.update()
    features = loop.encode(images)
    low, high = (loop.critic(features, th.tensor([[first, 0.0]])).mean().item() for first in (-1.0, 1.0))
    assert low == pytest.approx(-5, abs=1.5) and high == pytest.approx(5, abs=1.5)
    assert np.mean([loop.act(images)[0, 0] for _ in range(50)]) > max(0.5, before + 0.3)


def test_every_contender_has_its_rows(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(peers, "find_spec", lambda name: None)
    monkeypatch.setattr(peers, "has_native_bfloat16", lambda device: True)
    table = pd.DataFrame(peers.measure(peers.camera("cpu", image_size=36, batch_size=4), rounds=1))
    single, double = {"SB3 SAC", "SB3 SAC shared"}, {"bare loop", "HAVESAC", "HAVESAC gve"}
    assert set(table["contender"]) == single | double and len(table) == 2 * (2 + 2 * 3)
    assert (table["median_ms"] > 0).all()
    table = pd.DataFrame(peers.measure(peers.vector(batch_size=4), rounds=1))
    assert list(table["contender"]) == ["SB3 SAC"] * 2 + ["HAVESAC"] * 2 + ["HAVESAC gve"] * 2
    assert set(table["what"]) == {"update", "learn"}
    assert "sbx is not installed" in capsys.readouterr().out
