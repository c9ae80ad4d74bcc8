"""Any space and any valid options: HAVESAC trains, or refuses by a ValueError that names the key or the option."""

from typing import Any

import numpy as np
import pytest
from envs import RandomSensors
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_have import HAVESAC

SIDES = st.integers(15, 130)
KEYS = st.sampled_from(
    ["rgb", "event", "left event", "0", "observation", "tiefe_°", "a.b", "state", "weights", "x" * 40]
)


def images() -> st.SearchStrategy[spaces.Space[Any]]:
    return st.builds(lambda h, w, c: spaces.Box(0, 255, (h, w, c), np.uint8), SIDES, SIDES, st.integers(1, 12))


def vectors() -> st.SearchStrategy[spaces.Space[Any]]:
    dtypes: Any = st.sampled_from([np.float32, np.float64, np.int64, np.int8, np.uint8])
    shapes = st.one_of(st.tuples(st.integers(1, 20)), st.tuples(st.integers(1, 6), st.integers(1, 6)))
    return st.builds(lambda shape, dtype: spaces.Box(0, 5, shape, dtype), shapes, dtypes)


def discrete() -> st.SearchStrategy[spaces.Space[Any]]:
    sizes = st.integers(1, 6)
    return st.one_of(
        st.builds(spaces.Discrete, sizes),
        st.builds(spaces.MultiDiscrete, st.lists(sizes, min_size=1, max_size=3)),
        st.builds(spaces.MultiBinary, sizes),
    )


SPACES = st.one_of(
    st.dictionaries(KEYS, st.one_of(images(), vectors(), discrete()), min_size=1, max_size=3).map(spaces.Dict),
    images(),
    vectors(),
)
OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "value_estimation": st.sampled_from(["have", "lve", "gve"]),
        "refusion": st.sampled_from(["convex", "monotone", "free"]),
        "target": st.sampled_from(["bellman", "paper"]),
        "local_coef": st.sampled_from([0, 0.5, 1.0]),
        "modality_dropout": st.sampled_from([0.0, 0.5]),
        "random_shift": st.integers(0, 4),
        "n_augmentations": st.integers(1, 2),
        "auxiliary": st.sampled_from([None, "deepmdp"]),
        "n_steps": st.integers(1, 3),
        "policy_delay": st.integers(1, 3),
        "target_update_interval": st.integers(1, 3),
        "train_freq": st.sampled_from([1, 3, (1, "episode")]),
        "gradient_steps": st.sampled_from([1, 2, -1]),
        "use_sde": st.booleans(),
        "ent_coef": st.sampled_from(["auto", 0.1]),
    },
)
POLICY_KWARGS = st.fixed_dictionaries(
    {"features_dim": st.integers(1, 9), "net_arch": st.sampled_from([[], [4], [4, 4], {"pi": [4], "qf": [3]}])},
    optional={"n_critics": st.integers(1, 3), "attention_dim": st.integers(1, 8), "precision": st.just("float32")},
)


def check(space: spaces.Space[Any], options: dict[str, Any], policy_kwargs: dict[str, Any]) -> None:
    small: dict[str, Any] = {"learning_starts": 6, "batch_size": 4, "buffer_size": 50, "seed": 0, "device": "cpu"}
    try:
        model = HAVESAC("MultiInputPolicy", RandomSensors(space), policy_kwargs=policy_kwargs, **small, **options)
        model.learn(20)
    except ValueError as error:
        keys = [*space.spaces] if isinstance(space, spaces.Dict) else ["observation"]
        names = [*(repr(key) for key in keys), *options, *policy_kwargs]
        assert any(name in str(error) for name in names), str(error)
        return
    assert model._n_updates > 0
    action, _ = model.predict(model.observation_space.sample())
    assert np.isfinite(action).all()


FEW = settings(deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)


@given(SPACES, OPTIONS, POLICY_KWARGS)
@settings(FEW, max_examples=50)
def test_constructor(space: spaces.Space[Any], options: dict[str, Any], policy_kwargs: dict[str, Any]) -> None:
    check(space, options, policy_kwargs)


@pytest.mark.study
@given(SPACES, OPTIONS, POLICY_KWARGS)
@settings(FEW, max_examples=500, derandomize=False)
def test_constructor_thoroughly(
    space: spaces.Space[Any], options: dict[str, Any], policy_kwargs: dict[str, Any]
) -> None:
    check(space, options, policy_kwargs)
