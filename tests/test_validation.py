"""Which spaces are images, vectors and actions; what is ambiguous is refused by name."""

import copy
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, fill_buffer, tiny_model, vector, vectors_space
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx_parity import assert_parity, enliven
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_have import HAVESAC, ModalityReplayBuffer, ModalityWeightsCallback
from sb3_have.common.encoders import MultiModalEncoder, one_hot
from sb3_have.common.log_names import log_names
from sb3_have.export import export_onnx, export_safetensors, load_policy
from sb3_have.have import AuxiliaryLoss
from sb3_have.have.auxiliary import LatentTransitions

FLOAT, BYTE = np.float32, np.uint8


def box(shape: tuple[int, ...], dtype: Any = BYTE, high: float = 255) -> spaces.Box:
    return spaces.Box(0, high, shape, dtype)


# -- Images


@pytest.mark.parametrize(
    "space, remedy",
    [
        (box((4, 64, 64, 3)), "VecFrameStack"),
        (box((2, 4, 40, 40, 3)), "VecFrameStack"),
        (box((3, 20, 30, 1), FLOAT, 1), "VecFrameStack"),
        (box((48, 48), FLOAT, 50), "channel axis"),
        (box((15, 40), np.uint16, 65535), "channel axis"),
        (box((48, 48), np.int8, 127), "channel axis"),
        (box((48, 48), np.bool_, 1), "channel axis"),
        (spaces.MultiBinary([48, 48]), "channel axis"),
        (box((48, 48), BYTE, 10), "channel axis"),
        (box((5, 5)), "channel axis"),
        (box((48, 48, 60)), "channels_first"),
        (box((48, 48, 48)), "channels_first"),
        (box((36, 48, 40)), "channels_first"),
        (box((64, 84, 40)), "channels_first"),
    ],
)
def test_images_that_would_be_misread_are_refused(space: spaces.Space[Any], remedy: str) -> None:
    with pytest.raises(ValueError, match="'camera'") as error:
        tiny_model(spaces.Dict({"camera": space, "state": vector(3)}))
    assert remedy in str(error.value)


@pytest.mark.parametrize(
    "space, read_as",
    [
        (box((5, 5), FLOAT, 1), None),
        (box((5, 5), BYTE, 10), None),
        (box((3, 100), FLOAT, 1), None),
        (box((4, 6), np.int8, 3), None),
        (spaces.MultiBinary([3, 4]), None),
        (box((36, 36, 3)), (3, 36, 36)),
        (box((36, 36, 30)), (30, 36, 36)),
        (box((30, 36, 36)), (30, 36, 36)),
        (box((40, 60, 12)), (12, 40, 60)),
        (box((1, 36, 36)), (1, 36, 36)),
    ],
)
def test_images_and_vectors(space: spaces.Space[Any], read_as: tuple[int, ...] | None) -> None:
    model = tiny_model(spaces.Dict({"camera": space, "state": vector(3)}))
    modality = model.critic.encoder.modalities["camera"]
    assert modality.is_image == (read_as is not None)
    if read_as is not None:
        assert modality.space.shape == read_as
    model.learn(12)


def test_channels_first_confirms_an_ambiguous_shape() -> None:
    space = spaces.Dict({"camera": box((40, 48, 60))})
    model = tiny_model(space, policy_kwargs={"net_arch": [4], "features_dim": 4, "channels_first": True})
    assert model.critic.encoder.modalities["camera"].space.shape == (40, 48, 60)
    model.learn(12)


def test_stacked_frames_are_stacked_by_sb3() -> None:
    def make() -> RandomSensors:
        return RandomSensors(spaces.Dict({"rgb": box((36, 36, 3)), "state": vector(3)}))

    with pytest.raises(ValueError, match=r"'rgb'.*VecFrameStack"):
        HAVESAC("MultiInputPolicy", FrameStackObservation(make(), 4), buffer_size=10)
    model = HAVESAC("MultiInputPolicy", VecFrameStack(DummyVecEnv([make]), 4), buffer_size=10, device="cpu")
    assert model.critic.encoder.modalities["rgb"].space.shape == (12, 36, 36)


# -- Discrete observations

DISCRETE: list[spaces.Space[Any]] = [
    spaces.Discrete(5),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiDiscrete([2, 3], start=[1, 4]),
    spaces.MultiDiscrete([2, 3], dtype=np.int32),
    spaces.MultiBinary(4),
]


@pytest.mark.parametrize("space", DISCRETE, ids=str)
def test_discrete_observations_are_encoded_one_hot(space: spaces.Space[Any], tmp_path: Path) -> None:
    values = [space.sample() for _ in range(20)]
    encoded = one_hot(th.as_tensor(np.array(values)), space).flatten(start_dim=1)
    expected: Any = [spaces.flatten(space, value) for value in values]
    np.testing.assert_array_equal(encoded.numpy(), expected)

    model = tiny_model(spaces.Dict({"gear": space, "state": vector(3)}), learning_starts=10)
    model.learn(30)
    model.save(tmp_path / "model")
    observation = model.observation_space.sample()
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    before, after = (m.predict(observation, deterministic=True)[0] for m in (model, loaded))
    np.testing.assert_array_equal(before, after)
    assert model.modality_weights(observation).keys() == {"gear", "state"}


def test_discrete_and_other_vectors_share_a_modality() -> None:
    space = spaces.Dict({"gear": spaces.Discrete(5), "state": vector(3)})
    encoder = MultiModalEncoder(space, 4, modalities={"all": ["gear", "state"]})
    assert encoder.modalities["all"].space.shape == (8,)
    features = encoder({"gear": th.tensor([0, 4]), "state": th.zeros(2, 3)})
    assert features.shape == (2, 1, 4) and not th.equal(features[0], features[1])


@pytest.mark.parametrize("space", DISCRETE, ids=str)
def test_discrete_observations_are_exported(space: spaces.Space[Any], tmp_path: Path) -> None:
    model = tiny_model(spaces.Dict({"gear": space, "state": vector(3)}))
    enliven(model.policy)
    export_safetensors(model, tmp_path / "policy")
    policy = load_policy(tmp_path / "policy", "cpu")
    assert policy.observation_space == model.observation_space
    export_onnx(policy, tmp_path / "policy.onnx")
    assert_parity(tmp_path / "policy.onnx", model.policy)


def test_matrices_of_choices_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'gear': expected a MultiDiscrete of one axis"):
        tiny_model(spaces.Dict({"gear": spaces.MultiDiscrete(np.array([[2, 3], [2, 2]]))}))


def test_a_single_discrete_observation() -> None:
    tiny_model(spaces.Discrete(3)).learn(12)


@pytest.mark.parametrize("discrete", [False, True])
def test_goal_environments_and_hindsight_replay(discrete: bool) -> None:
    env = BitFlippingEnv(n_bits=4, continuous=True, discrete_obs_space=discrete)
    model = HAVESAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        learning_starts=20,
        batch_size=8,
        buffer_size=200,
        policy_kwargs={"net_arch": [8], "features_dim": 8},
        device="cpu",
    )
    model.learn(40)
    assert model._n_updates > 0


# -- Actions


class Acting(RandomSensors):
    def __init__(self, action_space: spaces.Space[Any]):
        super().__init__(vectors_space())
        self.action_space = action_space


BIG = np.finfo(np.float32).max
BAD_ACTIONS = [
    spaces.Box(-10, 10, (3,), np.int64),
    spaces.Box(0, 255, (3,), np.uint8),
    spaces.Box(-BIG, BIG, (2,), np.float32),
    spaces.Box(np.array([-1, 0.5], FLOAT), np.array([1, 0.5], FLOAT), (2,), np.float32),
    spaces.Box(-np.inf, np.inf, (2,), np.float32),
    spaces.Box(np.array([0, -np.inf], FLOAT), np.array([1, 1], FLOAT), (2,), np.float32),
    spaces.Discrete(3),
    spaces.MultiDiscrete([2, 2]),
]


@pytest.mark.parametrize("space", BAD_ACTIONS, ids=str)
def test_actions_that_cannot_be_scaled_are_refused(space: spaces.Space[Any]) -> None:
    with pytest.raises(ValueError, match="action space"):
        HAVESAC("MultiInputPolicy", Acting(space), buffer_size=10)


@given(st.floats(-1e6, 1e6, width=32), st.floats(2**-6, 1e6, width=32))
@settings(max_examples=10, deadline=None)
def test_stored_actions_are_those_taken(low: float, width: float) -> None:
    space = spaces.Box(low, low + width, (1,), np.float32)
    if not space.high > space.low:
        return
    model = tiny_model(vectors_space(), env=Acting(space), learning_starts=5)
    model.learn(10)
    assert model.replay_buffer is not None
    stored = model.replay_buffer.actions[:10]
    assert np.isfinite(stored).all() and np.abs(stored).max() < 1.01


# -- Observations that an environment returns


class Scalar(RandomSensors):
    """Returns a number where its space has the shape (1,), which DummyVecEnv casts."""

    def __init__(self) -> None:
        super().__init__(spaces.Dict({"speed": vector(1), "state": vector(3)}))

    def step(self, action: np.ndarray) -> Any:
        observation, *rest = super().step(action)
        return {**observation, "speed": float(observation["speed"][0])}, *rest


def test_what_sb3_casts_is_accepted_at_the_end_of_an_episode_too() -> None:
    model = tiny_model(vectors_space(), env=Scalar(), learning_starts=100)
    model.learn(60)
    assert model._episode_num > 0


# -- SB3's habits


@pytest.mark.parametrize("use_sde", [False, True])
def test_a_policy_can_be_copied_after_training(use_sde: bool) -> None:
    model = tiny_model(vectors_space(), use_sde=use_sde)
    model.learn(20)
    observation = model.observation_space.sample()
    action = model.predict(observation, deterministic=True)[0]
    for twin in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        np.testing.assert_array_equal(twin.predict(observation, deterministic=True)[0], action)
    model.learn(20)


def test_load_takes_the_arguments_of_the_constructor(tmp_path: Path) -> None:
    kwargs: dict[str, Any] = {
        "policy_kwargs": {"net_arch": [4], "features_dim": 4},
        "value_estimation": "lve",
        "auxiliary": None,
    }
    model = HAVESAC("MultiInputPolicy", RandomSensors(vectors_space()), buffer_size=10, **kwargs)
    model.save(tmp_path / "model")
    assert HAVESAC.load(tmp_path / "model", env=model.get_env(), **kwargs).critic.value_estimation == "lve"
    changes: list[dict[str, Any]] = [{"value_estimation": "have"}, {"refusion": "free"}, {"auxiliary": "deepmdp"}]
    for change in changes:
        with pytest.raises(ValueError, match=next(iter(change))):
            HAVESAC.load(tmp_path / "model", **change)


def test_a_model_of_another_algorithm_is_refused(tmp_path: Path) -> None:
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "sac")
    with pytest.raises(ValueError, match="SACPolicy"):
        HAVESAC.load(tmp_path / "sac")


@pytest.mark.parametrize("name", ["features_extractor_class", "features_extractor_kwargs", "share_features_extractor"])
def test_features_extractors_of_sac_are_refused_with_the_remedy(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}.*encoder_classes"):
        HAVESAC("MultiInputPolicy", RandomSensors(vectors_space()), policy_kwargs={name: {}})


def test_numpy_integers_are_integers() -> None:
    two = np.int64(2)
    tiny_model(vectors_space(), policy_delay=two, target_update_interval=two, train_freq=two, gradient_steps=two).learn(
        12
    )
    tiny_model(vectors_space(), train_freq=(np.int32(2), "step")).learn(12)


def test_stored_observations_are_those_of_sb3() -> None:
    space = spaces.Dict({"rgb": box((6, 8, 8)), "speed": vector(2), "gear": spaces.Discrete(3)})
    stored = []
    for buffer_class, kwargs in [(DictReplayBuffer, {}), (ModalityReplayBuffer, {"n_stack": 2})]:
        buffer: Any = buffer_class(4, space, vector(1), device="cpu", n_envs=2, **kwargs)
        space.seed(0)
        assert not np.any(buffer.observations["rgb"])  # nothing yet
        for _ in range(6):
            obs, next_obs = (
                {key: np.stack([space[key].sample() for _ in range(2)]) for key in space} for _ in range(2)
            )
            buffer.add(obs, next_obs, np.zeros((2, 1)), np.zeros(2), np.zeros(2), [{}, {}])
        stored.append([buffer.observations, buffer.next_observations])
    for theirs, ours in zip(*stored, strict=True):
        for key in space:
            np.testing.assert_array_equal(theirs[key], ours[key])


def test_names_of_the_critic() -> None:
    model = tiny_model(vectors_space())
    fill_buffer(model, 10)
    assert model.replay_buffer is not None
    batch: Any = model.replay_buffer.sample(4)
    critic = model.critic
    assert critic.n_critics == 2
    assert th.equal(critic.q1_forward(batch.observations, batch.actions), critic(batch.observations, batch.actions)[0])


def test_parallel_training_of_the_zoo_is_refused() -> None:
    callbacks = pytest.importorskip("rl_zoo3.callbacks")
    model = tiny_model(vectors_space(), train_freq=(1, "episode"))
    for wrapped in (lambda callback: callback, lambda callback: [callback]):
        with pytest.raises(ValueError, match="ParallelTrainCallback"):
            model.learn(10, callback=wrapped(callbacks.ParallelTrainCallback(gradient_steps=5)))


# -- Logging


@given(st.lists(st.text("ab_", max_size=60), unique=True, max_size=8), st.integers(10, 30))
def test_log_names_are_short_and_different(names: list[str], length: int) -> None:
    short = log_names(names, length)
    assert short.keys() == set(names)
    assert len(set(short.values())) == len(names)
    assert all(len(value) <= length for value in short.values())
    assert all(short[name] == name for name in names if len(name) <= length)


def test_training_with_long_names(capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"front_left_fisheye_camera_{kind}" for kind in ("rgb", "depth", "infrared")]

    class Long(AuxiliaryLoss):
        terms: ClassVar[tuple[str, ...]] = tuple(f"prediction_of_what_the_camera_sees_{kind}" for kind in "ab")

        def forward(self, batch: LatentTransitions) -> dict[str, th.Tensor]:
            return {term: batch.features.square().mean() for term in self.terms}

    model = tiny_model(
        spaces.Dict({name: vector(2) for name in names}), auxiliary={"long": Long}, verbose=1, learning_starts=10
    )
    model.learn(60, ModalityWeightsCallback())
    assert "weight_front_left" in capsys.readouterr().out


@pytest.mark.parametrize("change", ["n_envs", "image", "n_stack", "actions"])
def test_a_replay_buffer_of_another_environment_is_refused(tmp_path: Path, change: str) -> None:
    def make(size: int = 36, n_envs: int = 1, n_stack: int = 1, action_dim: int = 2) -> HAVESAC:
        space = spaces.Dict({"rgb": box((size, size, 3)), "state": vector(3)})
        env: Any = DummyVecEnv([lambda: RandomSensors(space, action_dim=action_dim)] * n_envs)
        return tiny_model(space, env=VecFrameStack(env, n_stack) if n_stack > 1 else env)

    make().learn(12).save_replay_buffer(tmp_path / "buffer")
    changes: dict[str, Any] = {"n_envs": {"n_envs": 2}, "image": {"size": 40}, "n_stack": {"n_stack": 2}}
    other = make(**changes.get(change, {"action_dim": 3}))
    with pytest.raises(ValueError, match=r"the replay buffer in .* has"):
        other.load_replay_buffer(tmp_path / "buffer")
    other.learn(12)
    same = make()
    same.load_replay_buffer(tmp_path / "buffer")
    same.learn(12)
