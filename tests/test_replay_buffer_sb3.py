"""ModalityReplayBuffer at work: in SB3's algorithms and in HAVESAC, behind real wrappers, saved and loaded."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs import TINY, RandomSensors, image, sensors_space, tiny_model, vector, vectors_space
from gymnasium import spaces
from replay_reference import assert_same_samples, held
from sb3_contrib import TQC
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
)

from sb3_have import HAVESAC, ModalityReplayBuffer

Dict = dict[str, np.ndarray]


class Episodes(RandomSensors):
    """Episodes of 1 to 7 steps, ended by termination or truncation; now and then the sensors stand still or go dark."""

    def __init__(self, space: spaces.Space[Any], seed: int):
        super().__init__(space)
        self.rng = np.random.default_rng(seed)
        self.last: Dict = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.length, self.timeout = int(self.rng.integers(1, 8)), bool(self.rng.integers(2))
        return super().reset(seed=seed, options=options)

    def observe(self) -> Dict:
        kind = self.rng.integers(6)
        if kind == 0 and self.last:
            return {key: array.copy() for key, array in self.last.items()}
        self.last = self.observation_space.sample()
        if kind == 1:
            self.last = {key: np.zeros_like(array) for key, array in self.last.items()}
        return self.last


def episodes(n_envs: int = 2, size: int = 36) -> DummyVecEnv:
    space = spaces.Dict({"rgb": image(3, size), "event": image(5, size), "state": vector(4)})
    return DummyVecEnv([lambda index=index: Episodes(space, index) for index in range(n_envs)])  # type: ignore[misc]


def stack_then_transpose(n_envs: int = 2, n_stack: int = 3, size: int = 36) -> VecEnv:
    return VecTransposeImage(VecFrameStack(episodes(n_envs, size), n_stack))


def transpose_then_stack(n_envs: int = 2, n_stack: int = 3, size: int = 36) -> VecEnv:
    return VecFrameStack(VecTransposeImage(episodes(n_envs, size)), n_stack)


class Recording(ModalityReplayBuffer):
    """Feeds SB3's buffer beside itself."""

    def __init__(self, buffer_size: int, *args: Any, **kwargs: Any):
        super().__init__(buffer_size, *args, **kwargs)
        assert isinstance(self.observation_space, spaces.Dict)
        self.reference = DictReplayBuffer(buffer_size, self.observation_space, self.action_space, "cpu", self.n_envs)

    def add(self, *args: Any) -> None:
        super().add(*args)
        self.reference.add(*args)


def assert_records(buffer: ReplayBuffer | None, env: VecNormalize | None = None) -> None:
    assert isinstance(buffer, Recording)
    assert_same_samples(held(buffer.reference, env), held(buffer, env))


NET: dict[str, Any] = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}


def algorithm(
    model_class: type[OffPolicyAlgorithm], env: VecEnv | gym.Env[Any, Any], buffer: type[ReplayBuffer], **kwargs: Any
) -> Any:
    """A small SB3 model with the replay buffer ``buffer``."""
    defaults: dict[str, Any] = {"buffer_size": 60, "learning_starts": 10, "batch_size": 8, "seed": 0, "device": "cpu"}
    net = {**NET, "n_quantiles": 5} if model_class is TQC else dict(NET)
    return model_class("MultiInputPolicy", env, replay_buffer_class=buffer, policy_kwargs=net, **{**defaults, **kwargs})


# -- Behind real wrappers


@pytest.mark.parametrize("wrapped", [stack_then_transpose, transpose_then_stack])
@pytest.mark.parametrize("n_stack", [2, 4])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_rollouts_behind_frame_stacks(wrapped: Any, n_stack: int, n_envs: int) -> None:
    model = algorithm(
        SAC,
        wrapped(n_envs, n_stack, size=36),
        Recording,
        learning_starts=10**6,
        replay_buffer_kwargs={"n_stack": n_stack},
    )
    for _ in range(3):  # each call resets the environment, without a done
        model.learn(51 * n_envs)
        assert_records(model.replay_buffer)
    assert model.replay_buffer.full
    stacks = model.replay_buffer.reference.observations["rgb"]
    assert (stacks[:, :, :3] == 0).all(axis=(2, 3, 4)).any()  # padded
    assert stacks[:, :, :3].any()


def test_rollouts_behind_frame_stacks_and_vec_normalize() -> None:
    env = VecNormalize(transpose_then_stack(), norm_obs_keys=["state"])
    model = algorithm(SAC, env, Recording, learning_starts=10**6, replay_buffer_kwargs={"n_stack": 3})
    model.learn(300)
    assert_records(model.replay_buffer)
    assert_records(model.replay_buffer, env)


def test_frames_are_held_once_behind_frame_stacks() -> None:
    """The frames that wrappers stack are found again: memory is far from what SB3 needs."""
    model = algorithm(
        SAC,
        stack_then_transpose(),
        Recording,
        buffer_size=200,
        learning_starts=10**6,
        replay_buffer_kwargs={"n_stack": 3},
    )
    model.learn(250)
    buffer = model.replay_buffer
    theirs = sum(2 * array.nbytes for array in buffer.reference.observations.values())
    # 4 steps an episode in the mean: 5 frames for 4 transitions, where SB3 holds 24
    assert buffer.nbytes < 0.3 * theirs


# -- In algorithms


@pytest.mark.parametrize("storage", ["memory", "device"])
@pytest.mark.parametrize("model_class", [SAC, TD3, TQC])
def test_algorithms_learn_the_same_bits(model_class: type[OffPolicyAlgorithm], storage: str) -> None:
    """Same seed, SB3's buffer against ours: every parameter is equal after training."""
    models = []
    variants: list[tuple[type[ReplayBuffer], dict[str, Any]]] = [
        (DictReplayBuffer, {}),
        (ModalityReplayBuffer, {"n_stack": 3, "storage": storage}),
    ]
    for buffer, kwargs in variants:
        model = algorithm(model_class, stack_then_transpose(), buffer, replay_buffer_kwargs=kwargs)
        model.learn(40)
        assert model._n_updates > 5
        models.append(model)
    parameters = [model.policy.state_dict() for model in models]
    assert parameters[0].keys() == parameters[1].keys()
    for name, tensor in parameters[0].items():
        assert th.equal(tensor, parameters[1][name]), name


def test_sac_with_n_step_returns_of_a_box() -> None:
    """As SB3's n-step buffer trains SAC, so does ours."""
    models = []
    for kwargs in [
        {"n_steps": 3},
        {"replay_buffer_class": ModalityReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3, "gamma": 0.99}},
    ]:
        env = RandomSensors(vector(4), length=7, timeout=True)
        model = SAC(
            "MlpPolicy", env, buffer_size=30, learning_starts=5, batch_size=8, policy_kwargs={"net_arch": [8]}, seed=0,
            device="cpu", **kwargs,  # type: ignore[arg-type]
        )  # fmt: skip
        model.learn(60)
        models.append(model)
    for name, tensor in models[0].policy.state_dict().items():
        assert th.allclose(tensor, models[1].policy.state_dict()[name], rtol=1e-4, atol=1e-6), name


# -- In HAVESAC


def test_havesac_finds_the_stack() -> None:
    model = tiny_model(sensors_space(), env=stack_then_transpose())
    assert type(model.replay_buffer) is ModalityReplayBuffer
    assert model.replay_buffer.n_stack == 3
    assert model.replay_buffer.n_envs == 2
    model.learn(40)
    assert model._n_updates > 0


@pytest.mark.parametrize(
    "wrapped,n_stack",
    [
        (lambda: VecFrameStack(episodes(), 3), 3),
        (transpose_then_stack, 3),
        (lambda: VecNormalize(transpose_then_stack(n_stack=2), norm_obs_keys=["state"]), 2),
        (lambda: VecFrameStack(VecFrameStack(episodes(), 2), 2), 2),
        (episodes, 1),
    ],
    ids=["stack", "transpose-stack", "normalize", "twice", "none"],
)
def test_stacks_in_the_chain(wrapped: Any, n_stack: int) -> None:
    model = tiny_model(sensors_space(), env=wrapped())
    assert isinstance(model.replay_buffer, ModalityReplayBuffer)
    assert model.replay_buffer.n_stack == n_stack
    assert is_vecenv_wrapped(model.env, VecTransposeImage)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "space,kwargs,expected",
    [
        (sensors_space(), {}, ModalityReplayBuffer),
        (image(3), {}, ModalityReplayBuffer),
        (vectors_space(), {"n_steps": 3}, ModalityReplayBuffer),
        (vectors_space(), {}, DictReplayBuffer),
        (vector(4), {}, ReplayBuffer),
        (sensors_space(), {"replay_buffer_class": DictReplayBuffer}, DictReplayBuffer),
    ],
    ids=["images", "image", "n-step vectors", "vectors", "vector", "asked for"],
)
def test_default_class(space: spaces.Space[Any], kwargs: dict[str, Any], expected: type[ReplayBuffer]) -> None:
    model = tiny_model(space, **kwargs)
    assert type(model.replay_buffer) is expected
    model.learn(20)
    assert model._n_updates > 0


def test_havesac_learns_the_same_bits_as_with_dict_replay_buffer() -> None:
    models = []
    variants: list[dict[str, Any]] = [{}, {"replay_buffer_class": DictReplayBuffer}]
    for kwargs in variants:
        model = tiny_model(sensors_space(), env=stack_then_transpose(), **kwargs)
        model.learn(40)
        models.append(model)
    for name, tensor in models[0].policy.state_dict().items():
        assert th.equal(tensor, models[1].policy.state_dict()[name]), name


@pytest.mark.parametrize("space", [sensors_space(), vectors_space()], ids=["images", "vectors"])
def test_n_step_returns_of_dict_observations(space: spaces.Dict) -> None:
    model = tiny_model(space, env=RandomSensors(space, length=9), n_steps=3, gamma=0.9)
    buffer = model.replay_buffer
    assert isinstance(buffer, ModalityReplayBuffer)
    assert (buffer.n_steps, buffer.gamma) == (3, 0.9)
    model.learn(40)
    assert model._n_updates > 0
    discounts = held(buffer).discounts
    assert np.unique(discounts.numpy()).tolist() == pytest.approx([0.9**3, 0.9**2, 0.9])


@pytest.mark.parametrize("kwargs", [{"storage": "device"}, {"storage": "mmap"}, {"n_steps": 2, "gamma": 0.8}])
def test_replay_buffer_kwargs_reach_the_default_buffer(kwargs: dict[str, Any], tmp_path: Path) -> None:
    if kwargs.get("storage") == "mmap":
        kwargs = {**kwargs, "mmap_dir": str(tmp_path)}
    model = tiny_model(sensors_space(), env=stack_then_transpose(), replay_buffer_kwargs=kwargs)
    buffer = model.replay_buffer
    assert isinstance(buffer, ModalityReplayBuffer)
    assert buffer.n_stack == 3
    options = {"n_steps": buffer.n_steps, "gamma": buffer.gamma, "storage": buffer.pool.storage}
    assert all(options[name] == value for name, value in kwargs.items() if name in options)
    model.learn(30)
    assert model._n_updates > 0


@pytest.mark.parametrize("storage", ["mmap", "device"])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_storages_give_the_same_samples(storage: str, n_steps: int, tmp_path: Path) -> None:
    samples = []
    for place in ["memory", storage]:
        kwargs = {"storage": place, **({"mmap_dir": str(tmp_path)} if place == "mmap" else {})}
        model = tiny_model(
            sensors_space(), env=stack_then_transpose(), replay_buffer_kwargs=kwargs, n_steps=n_steps, buffer_size=60,
            learning_starts=10**6,
        )  # fmt: skip
        model.learn(150)
        assert model.replay_buffer is not None
        np.random.seed(3)
        samples += [(held(model.replay_buffer), model.replay_buffer.sample(16))]
    for expected, ours in zip(*samples, strict=True):
        assert_same_samples(expected, ours)


def test_optimize_memory_usage_is_refused() -> None:
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        tiny_model(sensors_space(), optimize_memory_usage=True)


# -- Saving and loading


def add_step(buffer: ReplayBuffer, obs: Dict, next_obs: Dict, reward: float = 1.0, done: bool = False) -> None:
    n_envs = buffer.n_envs
    for each in [obs, next_obs]:
        assert all(len(array) == n_envs for array in each.values())
    buffer.add(
        {key: array.copy() for key, array in obs.items()},  # type: ignore[arg-type]
        {key: array.copy() for key, array in next_obs.items()},  # type: ignore[arg-type]
        np.zeros((n_envs, 2), np.float32),
        np.full(n_envs, reward),
        np.full(n_envs, done),
        [{} for _ in range(n_envs)],
    )


def sequence(space: spaces.Dict, n_envs: int, n_stack: int, length: int) -> list[Dict]:
    """Observations of one long episode, as if stacked."""
    rng = np.random.default_rng(0)
    frames = {}
    for key, box in space.items():
        assert box.shape is not None
        shape = (length + n_stack, n_envs, box.shape[0] // n_stack, *box.shape[1:])
        frames[key] = rng.integers(0, 256, shape).astype(box.dtype)
    return [
        {key: np.concatenate(list(array[start : start + n_stack]), axis=1) for key, array in frames.items()}
        for start in range(length)
    ]


@pytest.mark.parametrize("storage", ["memory", "mmap", "device"])
@pytest.mark.parametrize("truncate", [True, False])
def test_loaded_buffer_and_n_step_returns(truncate: bool, storage: str, tmp_path: Path) -> None:
    """With ``truncate_last_traj=False`` a return runs over the load, otherwise it ends there."""
    kwargs = {"storage": storage, **({"mmap_dir": str(tmp_path)} if storage == "mmap" else {})}
    model = tiny_model(
        sensors_space(), env=stack_then_transpose(), n_steps=3, gamma=0.5, buffer_size=40, replay_buffer_kwargs=kwargs
    )
    assert isinstance(model.observation_space, spaces.Dict)
    observations = sequence(model.observation_space, n_envs=2, n_stack=3, length=12)
    steps = list(pairwise(observations))
    assert model.replay_buffer is not None
    for obs, next_obs in steps[:6]:
        add_step(model.replay_buffer, obs, next_obs)
    before = held(model.replay_buffer)
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=truncate)
    buffer = model.replay_buffer
    assert isinstance(buffer, ModalityReplayBuffer)
    assert_same_samples(before, held(buffer))
    for obs, next_obs in steps[6:]:
        add_step(buffer, obs, next_obs)
    np.random.seed(0)
    samples = buffer._get_samples(np.arange(11))
    # 6 steps before the load, 5 after it
    expected = [1.75, 1.75, 1.75, 1.75, 1.5, 1.0] if truncate else [1.75] * 6
    assert samples.rewards.squeeze(1).tolist() == [*expected, 1.75, 1.75, 1.75, 1.5, 1.0]


@pytest.mark.parametrize("truncate", [True, False])
def test_a_loaded_model_goes_on(truncate: bool, tmp_path: Path) -> None:
    """Rollouts before and after the load, in a new model: what SB3's buffer would hold."""
    kwargs: dict[str, Any] = {"replay_buffer_class": Recording, "replay_buffer_kwargs": {"n_stack": 3}}
    model = tiny_model(sensors_space(), env=stack_then_transpose(), buffer_size=60, **kwargs)
    model.learn(45)
    model.save_replay_buffer(tmp_path / "buffer")
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", env=stack_then_transpose(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=truncate)
    assert_records(loaded.replay_buffer)
    for _ in range(3):
        loaded.learn(40, reset_num_timesteps=False)
        loaded.num_timesteps = 0
        assert_records(loaded.replay_buffer)
    assert loaded.replay_buffer is not None
    assert loaded.replay_buffer.full


def test_a_loaded_model_has_a_buffer_of_its_own_kind(tmp_path: Path) -> None:
    """The default buffer, its stack and its n-step returns come back with the model."""
    model = tiny_model(sensors_space(), env=stack_then_transpose(), n_steps=3, gamma=0.9)
    model.learn(30)
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", env=stack_then_transpose(), device="cpu")
    buffer = loaded.replay_buffer
    assert isinstance(buffer, ModalityReplayBuffer)
    assert (buffer.n_stack, buffer.n_steps, buffer.gamma, buffer.size()) == (3, 3, 0.9, 0)
    loaded.learn(30)
    assert loaded._n_updates > model._n_updates


def test_mmap_survives_its_model(tmp_path: Path) -> None:
    """A pickle stands for itself: it loads where the files of the memory map are gone."""
    folder = tmp_path / "frames"
    folder.mkdir()
    kwargs = {"storage": "mmap", "mmap_dir": str(folder)}
    model = tiny_model(sensors_space(), env=stack_then_transpose(), replay_buffer_kwargs=kwargs)
    model.learn(30)
    assert model.replay_buffer is not None
    expected = held(model.replay_buffer)
    model.save_replay_buffer(tmp_path / "buffer")
    for file in folder.iterdir():
        file.unlink()
    other = tiny_model(sensors_space(), env=stack_then_transpose(), policy_kwargs=TINY)
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer is not None
    assert_same_samples(expected, held(other.replay_buffer))
    other.learn(30)


def test_model_is_loaded_where_its_mmap_directory_is_not(tmp_path: Path) -> None:
    """To predict, no replay memory is needed."""
    kwargs = {"storage": "mmap", "mmap_dir": str(tmp_path / "frames")}
    model = tiny_model(sensors_space(), env=stack_then_transpose(), replay_buffer_kwargs=kwargs)
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model")
    loaded.predict(loaded.observation_space.sample())
    with pytest.raises(ValueError, match="mmap_dir"):
        HAVESAC.load(tmp_path / "model", env=stack_then_transpose()).learn(4)


@pytest.mark.parametrize("given,n_steps", [({}, 1), ({"n_steps": 2}, 2)], ids=str)
def test_loaded_buffer_has_the_models_n_steps(given: dict[str, Any], n_steps: int, tmp_path: Path) -> None:
    model = tiny_model(sensors_space(), env=stack_then_transpose(), n_steps=3, gamma=0.9)
    model.learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    other = tiny_model(sensors_space(), env=stack_then_transpose(), gamma=0.5, replay_buffer_kwargs=given)
    other.load_replay_buffer(tmp_path / "buffer")
    assert isinstance(other.replay_buffer, ModalityReplayBuffer)
    assert (other.replay_buffer.n_steps, other.replay_buffer.gamma) == (n_steps, 0.5)
