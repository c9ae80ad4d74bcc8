"""Bad input is refused early, by a message that names the key, what it is, and what to do."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, image, sensors_space, tiny_model, vector, vectors_space
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_have import HAVESAC
from sb3_have.common.encoders import MultiModalEncoder


def refused(call: Callable[[], Any], *parts: str) -> str:
    """``call`` raises a ValueError whose message has every part."""
    with pytest.raises(ValueError) as error:
        call()
    message = str(error.value)
    for part in parts:
        assert part in message, f"{part!r} is not in: {message}"
    return message


# -- When the model is built


def test_spaces_that_cannot_be_encoded() -> None:
    refused(lambda: MultiModalEncoder(spaces.Dict({"name": spaces.Text(5)})), "'name'", "flatten")


def test_unknown_keys_in_modalities() -> None:
    message = refused(lambda: model_with_modalities({"vision": ["rgb", "lidar"]}), "'vision'", "'lidar'")
    assert "'rgb'" in message and "'event'" in message  # what there is


def model_with_modalities(modalities: Any) -> HAVESAC:
    return tiny_model(sensors_space(), policy_kwargs={"modalities": modalities})


@pytest.mark.parametrize("modalities,parts", [({}, ["modalities", "empty"]), ({"vision": []}, ["'vision'", "list"])])
def test_empty_modalities(modalities: Any, parts: list[str]) -> None:
    refused(lambda: model_with_modalities(modalities), *parts)


def test_a_key_in_place_of_a_list_of_keys() -> None:
    refused(lambda: model_with_modalities({"vision": "rgb"}), "'vision'", "'rgb'", "list")


def test_keys_that_do_not_fit_together() -> None:
    refused(
        lambda: model_with_modalities({"all": ["rgb", "state"]}), "'all'", "'rgb'", "(4,)", "each of them a modality"
    )
    two_sizes = spaces.Dict({"near": image(3, 36), "far": image(3, 40)})
    refused(lambda: tiny_model(two_sizes, {"modalities": {"both": ["near", "far"]}}), "'both'", "36", "40")


@pytest.mark.parametrize("option", ["encoder_classes", "encoder_kwargs", "signed_keys"])
def test_options_of_unknown_modalities(option: str) -> None:
    value: Any = ["lidar"] if option == "signed_keys" else {"lidar": {}}
    refused(lambda: tiny_model(sensors_space(), {option: value}), option, "'lidar'", "'rgb'")


@pytest.mark.parametrize(
    "box",
    [
        spaces.Box(0.0, 1.0, (3, 36, 36), np.float32),
        spaces.Box(-128, 127, (3, 36, 36), np.int8),
        spaces.Box(0, 100, (3, 36, 36), np.uint8),
    ],
    ids=["float", "signed", "narrow"],
)
def test_images_that_are_not_bytes(box: spaces.Box) -> None:
    space = spaces.Dict({"camera": box, "state": vector(2)})
    refused(lambda: tiny_model(space), "'camera'", str(box.dtype), "(3, 36, 36)", "convert", "normalize_images=False")
    if box.dtype != np.uint8:
        tiny_model(space, {"normalize_images": False}).learn(12)


def test_float_images_with_the_channel_last() -> None:
    space = spaces.Dict({"camera": spaces.Box(0.0, 1.0, (36, 36, 3), np.float32)})
    refused(lambda: tiny_model(space, {"normalize_images": False}), "'camera'", "(36, 36, 3)", "channel-first")


def test_images_that_are_too_small() -> None:
    refused(lambda: tiny_model(spaces.Dict({"thumb": image(3, 12)})), "12", "15x15", "enlarge", "layers")


@pytest.mark.parametrize("action_space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 2])])
@pytest.mark.parametrize("vectorized", [False, True])
def test_discrete_actions(action_space: spaces.Space[Any], vectorized: bool) -> None:
    env: Any = RandomSensors(vectors_space())
    env.action_space = action_space
    if vectorized:
        single = env
        env = DummyVecEnv([lambda: single])
    message = refused(lambda: HAVESAC("MultiInputPolicy", env, device="cpu"), "action", "Box")
    assert type(action_space).__name__ in message and "wrapper" in message


@pytest.mark.parametrize(
    "option,value,expected",
    [
        ("value_estimation", "global", "'gve'"),
        ("refusion", "linear", "'monotone'"),
        ("target", "double", "'bellman'"),
        ("local_coef", -1.0, ">= 0"),
        ("modality_dropout", 1.0, "[0, 1)"),
        ("modality_dropout", -0.1, "[0, 1)"),
        ("auxiliary", "deepmpd", "'deepmdp'"),
    ],
)
def test_values_of_options(option: str, value: Any, expected: str) -> None:
    refused(lambda: tiny_model(vectors_space(), **{option: value}), option, repr(value), expected)


@pytest.mark.parametrize(
    "option,value,expected", [("precision", "float16", "'bfloat16'"), ("refusion", "linear", "'monotone'")]
)
def test_values_of_policy_options(option: str, value: Any, expected: str) -> None:
    refused(lambda: tiny_model(vectors_space(), {option: value}), option, repr(value), expected)


def test_an_encoder_of_the_wrong_size_is_named() -> None:
    class Wide(th.nn.Module):
        def __init__(self, space: spaces.Box, features_dim: int):
            super().__init__()
            self.net = th.nn.Linear(space.shape[0], features_dim + 1)

        def forward(self, observations: th.Tensor) -> th.Tensor:
            features: th.Tensor = self.net(observations)
            return features

    def build_and_use() -> None:
        model = tiny_model(vectors_space(), {"encoder_classes": {"b": Wide}})
        model.predict(model.observation_space.sample())

    refused(build_and_use, "'b'", "features_dim", "9", "8")


# -- While it runs


class Broken(RandomSensors):
    """Gives ``value`` in the observation key ``key`` or as the reward, at step ``at`` (0: at reset)."""

    def __init__(self, key: str, at: int, value: float = np.nan, **kwargs: Any):
        super().__init__(spaces.Dict({"state": vector(3), "speed": vector(1)}), **kwargs)
        self.key, self.at, self.value = key, at, value

    def observe(self) -> Any:
        observation = super().observe()
        if self.steps == self.at and self.key in observation:
            observation[self.key][0] = self.value
        return observation

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        broken = self.key == "reward" and self.steps == self.at
        return observation, self.value if broken else reward, terminated, truncated, info


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("at", [0, 3])
def test_observations_that_are_not_numbers(at: int, value: float) -> None:
    env = Broken("speed", at, value)
    model = tiny_model(env.observation_space, env=env)
    refused(lambda: model.learn(20), "'speed'", "NaN", "VecCheckNan")
    assert model.num_timesteps <= at + 1


@pytest.mark.parametrize("timeout", [True, False])
def test_last_observation_of_an_episode_that_is_not_a_number(timeout: bool) -> None:
    """It is not what the vectorised environment returns, but it is what the replay buffer stores."""
    env = Broken("speed", 5, length=5, timeout=timeout)
    model = tiny_model(env.observation_space, env=env)
    refused(lambda: model.learn(20), "'speed'", "NaN")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rewards_that_are_not_numbers(value: float) -> None:
    env = Broken("reward", 4, value)
    model = tiny_model(env.observation_space, env=env)
    refused(lambda: model.learn(20), "reward", str(value), "step 4", "environment")


def good_observation(space: spaces.Space[Any]) -> dict[str, np.ndarray]:
    space.seed(0)
    observation: dict[str, np.ndarray] = space.sample()
    return observation


@pytest.mark.parametrize("method", ["predict", "modality_weights"])
def test_observations_to_act_on(method: str) -> None:
    model = tiny_model(sensors_space())
    act = getattr(model, method)
    good = good_observation(sensors_space())
    act(good)
    without = {key: value for key, value in good.items() if key != "event"}
    refused(lambda: act(without), "'event'", "missing", "zeros")
    refused(lambda: act({**good, "lidar": good["state"]}), "'lidar'", "unknown")
    refused(lambda: act({**good, "state": np.array([0, np.nan, 0, 0], np.float32)}), "'state'", "NaN", "1 of 4")
    refused(lambda: act(good["state"]), "dict", "'event'", "ndarray")


@pytest.mark.parametrize(
    "key,value",
    [
        ("rgb", np.zeros((40, 36, 3), np.uint8)),
        ("rgb", np.zeros((36, 36), np.uint8)),
        ("event", np.zeros((2, 36, 36, 4), np.uint8)),
        ("state", np.zeros(5, np.float32)),
    ],
    ids=["height", "grey", "channels", "vector"],
)
def test_observations_of_the_wrong_shape(key: str, value: np.ndarray) -> None:
    model = tiny_model(sensors_space())
    observation = {**good_observation(sensors_space()), key: value}
    message = refused(lambda: model.predict(observation), repr(key), str(value.shape))
    expected = model.observation_space[key].shape  # type: ignore[index]
    assert str(expected) in message


def test_a_frame_that_was_not_stacked() -> None:
    space = spaces.Dict({"rgb": image(3), "state": vector(4)})
    model = tiny_model(space, env=VecFrameStack(DummyVecEnv([lambda: RandomSensors(space)]), n_stack=3))
    message = refused(lambda: model.predict(good_observation(space)), "'rgb'", "(36, 36, 3)")
    assert re.search(r"VecFrameStack|stack", message)


def test_images_of_floats_to_act_on() -> None:
    """A float image in [0, 1] would be decoded as if it were nearly black."""
    model = tiny_model(sensors_space())
    observation = {**good_observation(sensors_space()), "rgb": np.full((36, 36, 3), 0.5, np.float32)}
    refused(lambda: model.predict(observation), "'rgb'", "uint8", "float32")


def test_a_dict_for_a_box() -> None:
    model = tiny_model(vector(3))
    refused(lambda: model.predict({"state": np.zeros(3, np.float32)}), "(3,)", "'state'")


def test_weights_of_a_model_without_any() -> None:
    model = tiny_model(vectors_space(), value_estimation="gve")
    refused(lambda: model.modality_weights(good_observation(vectors_space())), "gve", "have", "lve")


def test_grey_images_without_a_channel() -> None:
    space = spaces.Dict({"grey": spaces.Box(0, 255, (36, 36), np.uint8)})
    refused(lambda: tiny_model(space), "'grey'", "(36, 36)", "channel axis")


def test_signed_keys_that_are_no_images() -> None:
    refused(lambda: tiny_model(sensors_space(), {"signed_keys": ["state"]}), "signed_keys", "'state'")


def test_one_option_in_two_places() -> None:
    refused(lambda: tiny_model(vectors_space(), {"refusion": "monotone"}, refusion="free"), "refusion", "once")
    assert tiny_model(vectors_space(), {"value_estimation": "gve"}).critic.value_estimation == "gve"


def test_loading_with_a_wrong_option(tmp_path: Path) -> None:
    tiny_model(vectors_space()).save(tmp_path / "model")
    refused(lambda: HAVESAC.load(tmp_path / "model", target="Paper"), "target='Paper'", "bellman")


@pytest.mark.parametrize("stacked", [False, True])
def test_vec_normalize_inside_of_what_changes_shapes(stacked: bool) -> None:
    env = VecNormalize(DummyVecEnv([lambda: RandomSensors(sensors_space())]), norm_obs_keys=["state"])
    model = tiny_model(sensors_space(), env=VecFrameStack(env, 2) if stacked else env)
    refused(lambda: model.learn(2), "VecNormalize", "VecTransposeImage")


def test_vec_normalize_on_images() -> None:
    env = VecNormalize(VecTransposeImage(DummyVecEnv([lambda: RandomSensors(sensors_space())])))
    refused(lambda: tiny_model(sensors_space(), env=env), "norm_obs_keys")
