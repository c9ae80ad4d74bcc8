"""The straight road and its drivers: highway-env's results to the last bit, and its errors noticed."""

from typing import Any

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from benchmarks import env_speed
from benchmarks.road_identity import KINDS, BlindEnv, StockEnv, compare
from sb3_have.envs.driver import Driver
from sb3_have.envs.road import HighwayRoad


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_same_bits_as_highway_env(kind: str, seed: int) -> None:
    row = compare(kind, seed, 150)
    assert row["recycled"] > 0 and row["lane_changes"] > 0
    assert row["crashed"] > 0 or kind == "episodes"


@pytest.mark.parametrize("options", [{"lanes_count": 1, "vehicles_count": 8}, {"vehicles_count": 40}])
def test_the_same_bits_on_other_roads(options: dict[str, Any]) -> None:
    assert compare("breakdowns", 0, 50, **options)["crashed"] > 0


def test_the_comparison_is_with_the_stock_classes() -> None:
    fast, stock = BlindEnv(), StockEnv()
    fast.reset(seed=0)
    stock.reset(seed=0)
    assert type(fast.road) is HighwayRoad and type(stock.road) is HighwayRoad.__base__
    assert {type(v) for v in fast.road.vehicles[1:]} == {Driver}
    assert {type(v) for v in stock.road.vehicles[1:]} == {IDMVehicle}
    assert type(stock.road.network) is type(fast.road.network).__base__


@pytest.mark.parametrize(
    ("owner", "name", "fault"),
    [
        (Driver, "DISTANCE_WANTED", 10.000001),
        (Driver, "KP_LATERAL", np.nextafter(IDMVehicle.KP_LATERAL, 2)),
        (HighwayRoad, "_close_pairs", lambda self, dt: []),
    ],
)
def test_the_comparison_notices_a_fault(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, fault: Any) -> None:
    monkeypatch.setattr(owner, name, fault)
    with pytest.raises(AssertionError, match="differ"):
        for seed in range(2):
            compare("breakdowns", seed, 120)


def test_contenders_of_the_speed_benchmark_drive_through_the_same_traffic() -> None:
    sensors = env_speed.Contender("HighwayVision-v0", 36, "WetNoon", ("depth",))
    paths = []
    for contender in (env_speed.STOCK, env_speed.Contender("no sensors"), sensors):
        drive = env_speed.Driver(env_speed.make_env(contender, 10, vehicles=10))
        for _ in range(20):
            drive()
        env: Any = drive.env.unwrapped
        paths.append([(*v.position.tolist(), v.speed) for v in env.road.vehicles])
    assert len(paths[0]) == 11 and paths[0] == paths[1] == paths[2]
    assert paths[0][0][2] > 5
