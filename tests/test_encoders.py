"""From raw observations to features: decoding, grouping, own encoders, frame stacking."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs import (
    IMAGE_SIZE,
    RandomSensors,
    batched,
    changed,
    clone_parameters,
    image,
    quiet_logger,
    sensors_space,
    tiny_model,
    vector,
)
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_have import HAVESAC
from sb3_have.common.crossq import MultiInputCrossQ
from sb3_have.common.encoders import ImageEncoder, MultiModalEncoder, MultiModalExtractor, VectorEncoder

SIZE = IMAGE_SIZE


def channel_first(channels: int, size: int = SIZE) -> spaces.Box:
    return spaces.Box(0, 255, (channels, size, size), np.uint8)


class Passing(th.nn.Module):
    """An encoder that keeps what it was given."""

    def __init__(self, space: spaces.Box, features_dim: int):
        super().__init__()
        self.features_dim = features_dim
        self.space = space

    def forward(self, observations: th.Tensor) -> th.Tensor:
        self.seen = observations.detach().clone()
        return observations.flatten(start_dim=1)[:, : self.features_dim]


def seen(encoder: MultiModalEncoder, observations: dict[str, th.Tensor]) -> dict[str, th.Tensor]:
    """What the encoder of each modality is given; all are :class:`Passing`."""
    encoder(observations)
    return {
        name: module.seen  # type: ignore[misc]
        for name, module in zip(encoder.modalities, encoder.encoders, strict=True)
    }


def passing(space: spaces.Dict, **kwargs: Any) -> MultiModalEncoder:
    names = kwargs.get("modalities", space.spaces)
    classes = dict.fromkeys(names, Passing)
    return MultiModalEncoder(space, 4, encoder_classes=classes, **{"precision": "float32", **kwargs})


def all_bytes(channels: int = 1) -> th.Tensor:
    """An image that holds every byte, (1, C, 16, 16)."""
    return th.arange(256, dtype=th.uint8).view(1, 1, 16, 16).repeat(1, channels, 1, 1)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_decoding_of_every_byte(precision: str) -> None:
    """Counts are (value - 128) / 8, images value / 255; 0 is "no data" in both, never -128 events."""
    space = spaces.Dict({"depth": channel_first(1, 16), "event": channel_first(1, 16)})
    decoded = seen(passing(space, precision=precision), {"depth": all_bytes(), "event": all_bytes()})
    values = np.arange(256)
    counts = np.where(values == 0, 0, values - 128) / 8
    tolerance = 1e-6 if precision == "float32" else 2**-8
    np.testing.assert_allclose(decoded["event"].float().flatten(), counts, rtol=tolerance)
    np.testing.assert_allclose(decoded["depth"].float().flatten(), values / 255, rtol=tolerance)
    assert decoded["event"].flatten()[0] == 0 and decoded["event"].flatten()[128] == 0
    assert decoded["event"].dtype == (th.float32 if precision == "float32" else th.bfloat16)


def test_every_count_survives_bfloat16() -> None:
    """Signed counts have at most 7 bits, bfloat16 has 8: nothing is lost."""
    space = spaces.Dict({"event": channel_first(1, 16)})
    exact, rough = (
        seen(passing(space, precision=precision), {"event": all_bytes()})["event"].float()
        for precision in ("float32", "bfloat16")
    )
    assert th.equal(exact, rough)


def test_signed_keys_and_normalize_images() -> None:
    space = spaces.Dict({"depth": channel_first(1, 16), "event": channel_first(1, 16)})
    observations = {"depth": all_bytes(), "event": all_bytes()}
    swapped = seen(passing(space, signed_keys=["depth"]), observations)
    assert swapped["depth"].min() == -127 / 8 and swapped["event"].min() == 0
    raw = seen(passing(space, normalize_images=False), observations)
    assert raw["event"].max() == 255 and raw["depth"].max() == 255


def test_decoding_leaves_the_observation_alone() -> None:
    """The buffers share memory with the tensors, so that decoding in place would spoil them."""
    space = spaces.Dict({"event": channel_first(2, 16), "rgb": channel_first(3, 16), "state": vector(4)})
    for dtype in (th.uint8, th.float32):
        observations = {"event": all_bytes(2).to(dtype), "rgb": all_bytes(3).to(dtype), "state": th.randn(1, 4)}
        # as SB3 transposes: channel-first views of channel-last memory
        observations = {
            key: value.contiguous(memory_format=th.channels_last) if value.dim() == 4 else value
            for key, value in observations.items()
        }
        kept = {key: value.clone() for key, value in observations.items()}
        seen(passing(space), observations)
        for key, value in observations.items():
            assert th.equal(value, kept[key]), (key, dtype)


def test_padding_of_frame_stacking_decodes_to_nothing() -> None:
    """A real VecFrameStack on an environment whose sensors are never empty: the two oldest frames are nothing."""

    class Busy(RandomSensors):
        def observe(self) -> dict[str, np.ndarray]:
            return {key: np.full(box.shape, 200, np.uint8) for key, box in self.observation_space.items()}  # type: ignore[attr-defined]

    space = spaces.Dict({"event": image(5), "depth": image(1)})
    env = VecFrameStack(DummyVecEnv([lambda: Busy(space)]), n_stack=3)
    model = tiny_model(space, env=env, policy_kwargs={"encoder_classes": {"event": Passing, "depth": Passing}})
    stacked, _ = model.policy.obs_to_tensor(env.reset())
    assert isinstance(stacked, dict)
    decoded = seen(model.critic.encoder, stacked)
    for key, channels, now in (("event", 5, (200 - 128) / 8), ("depth", 1, 200 / 255)):
        assert decoded[key].shape == (1, 3 * channels, SIZE, SIZE)
        padding, newest = decoded[key][:, : 2 * channels], decoded[key][:, 2 * channels :]
        assert not padding.any(), key
        assert th.allclose(newest, th.full_like(newest, now)), key


@pytest.mark.parametrize("size", [16, 36, 84, 112])
def test_images_of_many_sizes(size: int) -> None:
    th.manual_seed(0)
    encoder = ImageEncoder(channel_first(3, size), features_dim=10)
    features = encoder(th.rand(2, 3, size, size))
    assert features.shape == (2, 10)
    assert th.allclose(features.mean(dim=1), th.zeros(2), atol=1e-5)  # LayerNorm
    filters = [module for module in encoder.convolutions if isinstance(module, th.nn.Conv2d)]
    assert (len(filters) == 4) == (size >= 112)
    assert not th.allclose(features[0], features[1], atol=1e-3)


def test_precision_changes_little() -> None:
    space = spaces.Dict({"rgb": channel_first(3), "event": channel_first(5)})
    th.manual_seed(0)
    exact = MultiModalEncoder(space, 16, precision="float32")
    rough = MultiModalEncoder(space, 16, precision="bfloat16")
    rough.load_state_dict(exact.state_dict())
    images = {key: th.randint(0, 256, (8, *box.shape), dtype=th.uint8) for key, box in space.items()}  # type: ignore[misc]
    features, rounded = exact(images), rough(images)
    assert features.dtype == rounded.dtype == th.float32
    cosine = th.nn.functional.cosine_similarity(features.flatten(1), rounded.flatten(1), dim=1)
    assert cosine.min() > 0.999
    assert not th.equal(features, rounded)
    assert all(parameter.dtype == th.float32 for parameter in rough.parameters())


def test_modalities_are_independent_and_in_order() -> None:
    space = spaces.Dict({"rgb": channel_first(3), "event": channel_first(5), "state": vector(4)})
    encoder = MultiModalEncoder(space, 8, modalities={"state": ["state"], "event": ["event"], "rgb": ["rgb"]})
    assert list(encoder.modalities) == ["state", "event", "rgb"]
    space.seed(0)
    first, second = ({k: th.as_tensor(v[None]) for k, v in space.sample().items()} for _ in range(2))
    before = encoder(first)
    assert before.shape == (1, 3, 8)
    for i, name in enumerate(encoder.modalities):
        moved = (encoder({**first, name: second[name]}) != before).any(dim=2)[0]
        assert moved.tolist() == [j == i for j in range(3)]


def test_grouped_keys_share_an_encoder() -> None:
    space = spaces.Dict(
        {"rgb": channel_first(3), "depth": channel_first(1), "event": channel_first(5), "p": vector(2), "v": vector(3)}
    )
    groups = {"vision": ["rgb", "depth", "event"], "body": ["v", "p"]}
    space.seed(0)
    observations = {key: th.as_tensor(value[None]) for key, value in space.sample().items()}
    decoded = seen(passing(space, modalities=groups), observations)
    assert list(decoded) == ["vision", "body"]
    assert decoded["vision"].shape == (1, 9, SIZE, SIZE)
    assert th.allclose(decoded["vision"][:, 3:4], observations["depth"] / 255)
    assert decoded["vision"][:, 4:].min() < 0 <= decoded["vision"][:, :4].min()  # each key by its own code
    assert th.equal(decoded["body"], th.cat([observations["v"], observations["p"]], dim=1))
    model = MultiModalEncoder(space, 8, modalities=groups)
    assert isinstance(model.encoders[0], ImageEncoder) and isinstance(model.encoders[1], VectorEncoder)
    assert model(observations).shape == (1, 2, 8)


def test_keys_may_be_left_out() -> None:
    space = spaces.Dict({"rgb": channel_first(3), "state": vector(4)})
    encoder = MultiModalEncoder(space, 8, modalities={"state": ["state"]})
    space.seed(0)
    observations = {key: th.as_tensor(value[None]) for key, value in space.sample().items()}
    assert encoder(observations).shape == (1, 1, 8)


def test_encoders_of_sb3_and_their_arguments() -> None:
    space = spaces.Dict({"rgb": channel_first(3), "state": vector(4), "event": channel_first(5)})
    encoder = MultiModalEncoder(
        space,
        8,
        encoder_classes={"rgb": NatureCNN},
        encoder_kwargs={"state": {"net_arch": [7, 5]}, "event": {"layers": [(4, 5, 3), (6, 3, 2)]}},
    )
    by_name = dict(zip(encoder.modalities, encoder.encoders, strict=True))
    assert isinstance(by_name["rgb"], NatureCNN)
    shapes = [tuple(p.shape) for p in by_name["state"].parameters() if p.dim() == 2]
    assert shapes == [(7, 4), (5, 7), (8, 5)]
    shapes = [tuple(p.shape) for p in by_name["event"].parameters() if p.dim() == 4]
    assert shapes == [(4, 5, 5, 5), (6, 4, 3, 3)]
    images = {key: th.zeros(2, *box.shape, dtype=th.uint8) for key, box in space.items() if key != "state"}  # type: ignore[misc]
    assert encoder({**images, "state": th.zeros(2, 4)}).shape == (2, 3, 8)


def test_acting_and_training_see_the_same_features() -> None:
    """No statistics of the batch: the features of an observation do not depend on its neighbours."""
    space = spaces.Dict({"rgb": channel_first(3), "event": channel_first(5), "state": vector(4)})
    encoder = MultiModalEncoder(space, 8, precision="float32")
    space.seed(0)
    rows = [space.sample() for _ in range(5)]
    batch = {key: th.as_tensor(np.stack([row[key] for row in rows])) for key in rows[0]}
    together = encoder(batch)
    alone = encoder({key: value[2:3] for key, value in batch.items()})
    assert th.allclose(together[2:3], alone, atol=1e-5)


@pytest.mark.parametrize("space", [image(3), vector(6), spaces.Box(-1, 1, (4, 3), np.float32)])
def test_a_single_box_is_one_modality(space: spaces.Box) -> None:
    model = tiny_model(space)
    assert list(model.critic.encoder.modalities) == ["observation"]
    env: gym.Env[Any, Any] = RandomSensors(space)
    observation, _ = env.reset(seed=0)
    weights = model.modality_weights(observation)
    assert set(weights) == {"observation"} and weights["observation"] == pytest.approx([1.0])
    assert isinstance(model.learn(12), HAVESAC)


@pytest.mark.parametrize(
    "size,expected",
    [(84, [(32, 8, 4), (64, 4, 2), (64, 3, 1)]), (128, [(32, 3, 2), (32, 3, 1), (32, 3, 1), (32, 3, 1)])],
)
def test_default_layers_by_size(size: int, expected: list[tuple[int, int, int]]) -> None:
    """Nature DQN's for small images, the paper's from 112 pixels on."""
    layers = [m for m in ImageEncoder(channel_first(3, size)).convolutions if isinstance(m, th.nn.Conv2d)]
    assert [(layer.out_channels, layer.kernel_size[0], layer.stride[0]) for layer in layers] == expected


OFF_THE_SHELF: list[Any] = [SAC, TQC, MultiInputCrossQ]


def off_the_shelf(algorithm: Any, space: spaces.Space[Any], **policy_kwargs: Any) -> Any:
    """A small model on :class:`MultiModalExtractor`, on random observations of ``space``."""
    kwargs = {
        "features_extractor_class": MultiModalExtractor,
        "features_extractor_kwargs": {"features_dim": 8, "precision": "float32"},
        "normalize_images": False,
        "net_arch": [16],
        **policy_kwargs,
    }
    return algorithm(
        "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy",
        RandomSensors(space),
        learning_starts=8,
        batch_size=8,
        buffer_size=50,
        seed=0,
        device="cpu",
        policy_kwargs=kwargs,
    )


@pytest.mark.parametrize("algorithm", OFF_THE_SHELF)
def test_extractor_gives_the_features_of_the_raw_bytes(algorithm: Any) -> None:
    """What SB3 makes of an observation on its way to the extractor changes no bit of the features."""
    model = off_the_shelf(algorithm, sensors_space())
    extractor = model.critic.features_extractor
    assert extractor.features_dim == 3 * 8
    space = model.observation_space
    space.seed(0)
    observation = {key: np.stack([space[key].sample() for _ in range(4)]) for key in space.spaces}
    observation["event"][0] = 128  # nothing happened
    observation["event"][1] = 0  # no data
    reference = MultiModalEncoder(space, 8, precision="float32")
    reference.load_state_dict(extractor.encoder.state_dict())
    expected = reference({key: th.as_tensor(value) for key, value in observation.items()}).flatten(start_dim=1)
    tensors, _ = model.policy.obs_to_tensor(observation)
    assert th.equal(model.critic.extract_features(tensors, extractor), expected)


@pytest.mark.parametrize("algorithm", OFF_THE_SHELF)
def test_extractor_is_trained_and_comes_back(algorithm: Any, tmp_path: Path) -> None:
    model = off_the_shelf(algorithm, sensors_space())
    before = clone_parameters(model.critic.features_extractor)
    model.learn(12)
    assert changed(before, model.critic.features_extractor) == set(before)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    observation = batched(RandomSensors(sensors_space()).observation_space.sample())
    first, second = (one.predict(observation, deterministic=True)[0] for one in (model, loaded))
    assert np.array_equal(first, second)


def test_crossq_learns_from_a_dict_as_from_a_box() -> None:
    """To the same bits, where the only key holds what the Box holds."""
    models = [off_the_shelf(MultiInputCrossQ, space) for space in (vector(4), spaces.Dict({"a": vector(4)}))]
    rng = np.random.default_rng(0)
    for _ in range(20):
        observation, next_observation = rng.uniform(-1, 1, (2, 1, 4)).astype(np.float32)
        action, reward = rng.uniform(-1, 1, (1, 2)).astype(np.float32), rng.normal(size=1)
        pairs = [(observation, next_observation), ({"a": observation}, {"a": next_observation})]
        for model, pair in zip(models, pairs, strict=True):
            model.replay_buffer.add(*pair, action, reward, np.array([False]), [{}])
    before = clone_parameters(models[0].policy)
    for model in models:
        model.set_logger(quiet_logger())
        np.random.seed(0)
        th.manual_seed(0)
        model.train(3, batch_size=8)
    box, mapping = models
    assert changed(before, box.policy) == set(before)
    assert not changed(clone_parameters(box.policy), mapping.policy)


def test_crossq_without_an_extractor_of_its_own_has_that_of_sb3() -> None:
    space = spaces.Dict({"a": vector(4), "b": vector(3)})
    model = MultiInputCrossQ("MultiInputPolicy", RandomSensors(space), learning_starts=8, batch_size=8, device="cpu")
    assert type(model.critic.features_extractor) is CombinedExtractor
    assert model.learn(12)._n_updates > 0


@pytest.mark.parametrize("space", [sensors_space(), image(3)])
def test_extractor_refuses_images_that_sb3_has_scaled(space: spaces.Space[Any]) -> None:
    model = off_the_shelf(SAC, space, normalize_images=True)
    with pytest.raises(ValueError, match=r"'(rgb|event|observation)': expected the bytes.*normalize_images=False"):
        model.predict(RandomSensors(space).observation_space.sample())


def test_extractor_takes_floats_as_they_are_where_it_is_told_to() -> None:
    space = spaces.Dict({"rgb": spaces.Box(0, 1, (3, SIZE, SIZE), np.float32)})
    kwargs = {"features_dim": 8, "precision": "float32", "normalize_images": False}
    extractor = MultiModalExtractor(space, **kwargs)  # type: ignore[arg-type]
    observation = {"rgb": th.rand(2, 3, SIZE, SIZE)}
    assert th.equal(extractor(observation), extractor.encoder(observation)[:, 0])
