"""Fusion of feature maps: the modules against slow references, and what they are within encoders and policies."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import fusion_reference
import numpy as np
import pytest
import torch as th
from envs import batched, changed, clone_parameters, fill_buffer, image, quiet_logger, tiny_model
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_have import HAVESAC
from sb3_have.common.encoders import ImageEncoder, MultiModalEncoder, MultiModalExtractor
from sb3_have.common.fusion import CrossModalChannelAttention, FeatureFusion, Shape, Transfuser

# one modality to four: as wide as another and not, square and not, larger than 8x8 tokens and smaller
SHAPES: list[list[Shape]] = [
    [(8, 9, 12)],
    [(8, 9, 12), (8, 9, 12)],
    [(8, 3, 17), (12, 9, 12)],
    [(4, 5, 6), (8, 11, 4), (12, 5, 6)],
    [(8, 4, 4), (8, 4, 4), (4, 10, 9), (8, 1, 2)],
]
FUSIONS: list[type[FeatureFusion]] = [Transfuser, CrossModalChannelAttention]
NAMES = ["transfuser", "efnet"]


def drawn(fusion: type[FeatureFusion], shapes: Sequence[Shape], **kwargs: Any) -> FeatureFusion:
    """A fusion in float64 whose parameters are all far from their first values, zeros and ones among them."""
    th.manual_seed(0)
    module = fusion(shapes, **kwargs).double()
    for parameter in module.parameters():
        parameter.data.add_(th.randn_like(parameter), alpha=0.3)
    return module


def maps_of(shapes: Sequence[Shape], batch_size: int = 2, seed: int = 1) -> list[th.Tensor]:
    generator = th.Generator().manual_seed(seed)
    return [th.randn(batch_size, *shape, generator=generator, dtype=th.float64) for shape in shapes]


def reference(module: FeatureFusion, maps: Sequence[np.ndarray], n_heads: int, n_layers: int = 2) -> list[np.ndarray]:
    parameters = {name: value.detach().numpy() for name, value in module.state_dict().items()}
    if isinstance(module, Transfuser):
        return fusion_reference.transfuser(maps, parameters, n_layers, n_heads)
    return fusion_reference.channel_attention(maps, parameters, n_heads)


@pytest.mark.parametrize("shapes", SHAPES, ids=str)
@pytest.mark.parametrize("fusion", FUSIONS)
def test_slow_reference(fusion: type[FeatureFusion], shapes: list[Shape]) -> None:
    module, maps = drawn(fusion, shapes), maps_of(shapes)
    memory = [values.contiguous(memory_format=th.channels_last) for values in maps]
    expected = reference(module, [values[1].numpy() for values in maps], n_heads=4)
    for given in (maps, memory):
        for fused, right in zip(module(given), expected, strict=True):
            np.testing.assert_allclose(fused[1].detach().numpy(), right, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "fusion,kwargs",
    [
        (Transfuser, {"n_layers": 1, "n_heads": 2, "mlp_ratio": 3}),
        (CrossModalChannelAttention, {"n_heads": 1, "mlp_ratio": 1}),
    ],
)
def test_slow_reference_of_other_sizes(fusion: type[FeatureFusion], kwargs: dict[str, int]) -> None:
    shapes: list[Shape] = [(6, 9, 7), (6, 4, 5)]
    module, maps = drawn(fusion, shapes, **kwargs), maps_of(shapes, 1)
    sizes = {name: value for name, value in kwargs.items() if name != "mlp_ratio"}
    expected = reference(module, [values[0].numpy() for values in maps], **sizes)
    for fused, right in zip(module(maps), expected, strict=True):
        np.testing.assert_allclose(fused[0].detach().numpy(), right, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shapes", SHAPES, ids=str)
@pytest.mark.parametrize("fusion", FUSIONS)
def test_gradients_reach_every_parameter_and_map(fusion: type[FeatureFusion], shapes: list[Shape]) -> None:
    module, maps = drawn(fusion, shapes), maps_of(shapes)
    inputs = [values.requires_grad_() for values in maps]
    fused = module(inputs)
    # not the sum: a gradient that is the same in all channels would vanish in a LayerNorm
    th.autograd.backward([(values * th.randn_like(values)).sum() for values in fused])
    for name, parameter in module.named_parameters():
        assert parameter.grad is not None, name
        parts = parameter.grad.chunk(3) if "qkv" in name else [parameter.grad]
        if name.endswith("qkv.bias"):
            parts = [parts[0], parts[2]]  # a key's bias shifts all scores of a query alike, which no softmax notices
        if name.endswith(("positions", "temperature")):
            parts = list(parameter.grad)
        assert all(part.abs().max() > 1e-8 for part in parts), name
    assert all((values.grad != 0).all() for values in inputs)  # type: ignore[union-attr]


@pytest.mark.parametrize("shapes", SHAPES, ids=str)
@pytest.mark.parametrize("fusion", FUSIONS)
def test_nothing_is_added_at_first(fusion: type[FeatureFusion], shapes: list[Shape]) -> None:
    """A new fusion gives the maps back to the bit; two updates later none of its parameters is where it began."""
    th.manual_seed(0)
    module, maps = fusion(shapes).double(), maps_of(shapes)
    assert all(th.equal(*pair) for pair in zip(module(maps), maps, strict=True))
    before, optimizer = clone_parameters(module), th.optim.Adam(module.parameters())
    wanted = maps_of(shapes, seed=2)
    for _ in range(2):
        optimizer.zero_grad()
        th.autograd.backward([(a - b).square().mean() for a, b in zip(module(maps), wanted, strict=True)])
        optimizer.step()
    assert changed(before, module) == set(before)


@pytest.mark.parametrize("fusion", FUSIONS)
def test_modalities_see_each_other_and_samples_do_not(fusion: type[FeatureFusion]) -> None:
    shapes = SHAPES[3]
    module, maps = drawn(fusion, shapes), maps_of(shapes, 5)
    fused = module(maps)
    order = th.tensor([3, 0, 4, 1, 2])
    for shuffled, values in zip(module([values[order] for values in maps]), fused, strict=True):
        assert th.allclose(shuffled, values[order], rtol=1e-12, atol=1e-12)
    for j in range(3):
        others = [values.clone() for values in maps]
        others[j][2] += 1.0 + th.arange(5 * 6 if j != 1 else 44).view(shapes[j][1:])
        for values, before in zip(module(others), fused, strict=True):
            moved = (values != before).flatten(1).any(dim=1)
            assert moved.tolist() == [False, False, True, False, False], j


def test_tokens_keep_their_places() -> None:
    """
    A transformer without layers gives each token back, normed: the maps plus their own areas, none of them transposed,
    in another channel or of another modality.
    """
    shapes: list[Shape] = [(4, 8, 16), (4, 24, 8)]
    module = Transfuser(shapes, n_layers=0).double()
    th.nn.init.zeros_(module.positions)
    module.norm = th.nn.Identity()  # type: ignore[assignment]
    maps = maps_of(shapes, 1)
    fused = module(maps)
    areas = [maps[0].view(1, 4, 8, 8, 2).mean(dim=4), maps[1].view(1, 4, 8, 3, 8).mean(dim=3)]
    for values, before, area in zip(fused, maps, areas, strict=True):
        added = th.nn.functional.interpolate(area, values.shape[2:], mode="bilinear")
        assert th.allclose(values, before + added, atol=1e-12)


def test_positions_are_of_tokens_and_modalities() -> None:
    """Tokens of one content differ by their places, and so do modalities."""
    shapes: list[Shape] = [(4, 2, 3), (4, 2, 3)]
    module = drawn(Transfuser, shapes)
    fused = module([th.ones(1, *shape, dtype=th.float64) for shape in shapes])
    places = th.cat([values.detach().flatten(2) for values in fused], dim=2)[0].T
    assert (th.cdist(places, places) + th.eye(12)).min() > 1e-3


@pytest.mark.parametrize("fusion", FUSIONS)
def test_bfloat16_changes_little(fusion: type[FeatureFusion]) -> None:
    shapes: list[Shape] = [(32, 8, 8), (32, 8, 8)]
    module = drawn(fusion, shapes).float()
    maps = [values.float().contiguous(memory_format=th.channels_last) for values in maps_of(shapes, 4)]
    exact = module(maps)
    with th.autocast("cpu", dtype=th.bfloat16):
        rough = module([values.bfloat16() for values in maps])
    for values, rounded in zip(exact, rough, strict=True):
        assert rounded.dtype == th.bfloat16
        assert rounded.is_contiguous(memory_format=th.channels_last) and values.is_contiguous(
            memory_format=th.channels_last
        )
        assert (values - rounded).norm() < 0.01 * values.norm()


def two_images(size: int = 36, names: str = "rgb event") -> spaces.Dict:
    """As the policy sees them, channels first."""
    channels = {"rgb": 3, "event": 5, "depth": 1}
    return spaces.Dict({name: spaces.Box(0, 255, (channels[name], size, size), np.uint8) for name in names.split()})


def sampled(space: spaces.Dict, batch_size: int = 4) -> dict[str, th.Tensor]:
    space.seed(0)
    return {key: th.as_tensor(np.stack([box.sample() for _ in range(batch_size)])) for key, box in space.items()}


@pytest.mark.parametrize(
    "fusion,stated,doc", [("transfuser", 102_144, Transfuser), ("efnet", 66_952, CrossModalChannelAttention)]
)
def test_parameter_count_that_the_docstring_states(fusion: str, stated: int, doc: type[FeatureFusion]) -> None:
    encoder = MultiModalEncoder(two_images(64), fusion=fusion)
    assert sum(parameter.numel() for parameter in encoder.fusions.parameters()) == stated
    assert f"{stated:,} parameters for HighwayVision-v0" in (doc.__doc__ or "")


def test_no_fusion_is_the_encoders_alone() -> None:
    """Bit by bit, and with the same names of parameters."""
    space = two_images()
    th.manual_seed(0)
    encoder = MultiModalEncoder(space, 8, precision="float32")
    assert not any("fusion" in name for name in encoder.state_dict())
    observations = sampled(space)
    decoded = {"rgb": observations["rgb"] / 255}
    decoded["event"] = th.where(observations["event"] == 0, 0, observations["event"].float() - 128) / 8
    for i, name in enumerate(encoder.modalities):
        alone = encoder.encoders[i]
        assert isinstance(alone, ImageEncoder)
        maps = alone.convolutions(decoded[name].contiguous(memory_format=th.channels_last))
        features = alone.output(maps.permute(0, 2, 3, 1).flatten(start_dim=1))
        assert th.equal(encoder(observations)[:, i], features)


class Recording(FeatureFusion):
    """An own fusion: adds ``amount``, and keeps what it saw."""

    def __init__(self, shapes: Sequence[Shape], amount: float = 0.0):
        super().__init__(shapes)
        self.amount = amount

    def forward(self, maps: Sequence[th.Tensor]) -> list[th.Tensor]:
        self.seen = [values.detach().clone() for values in maps]
        return [values + self.amount for values in maps]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_own_fusion_that_changes_nothing(precision: str) -> None:
    """Stage by stage is the same as all at once, and the fusion sees the maps of the shapes that it was built for."""
    space = two_images(names="rgb event depth")
    th.manual_seed(0)
    plain = MultiModalEncoder(space, 8, precision=precision)
    fused = MultiModalEncoder(space, 8, precision=precision, fusion=Recording, fusion_kwargs={"stages": "all"})
    fused.load_state_dict(plain.state_dict())
    observations = sampled(space)
    assert th.equal(plain(observations), fused(observations))
    assert list(fused.fusions) == ["0", "1", "2"]
    for module in fused.fusions.values():
        assert isinstance(module, Recording)
        assert [tuple(values.shape[1:]) for values in module.seen] == module.shapes
        assert all(values.min() == 0 for values in module.seen)  # behind the ReLU
        assert module.seen[0].dtype == (th.float32 if precision == "float32" else th.bfloat16)


@pytest.mark.parametrize("stages,chosen", [("last", "2"), ("all", "012"), ([1], "1"), ((2, 0), "02")])
def test_stages_of_a_fusion(stages: Any, chosen: str) -> None:
    space = two_images()
    encoder = MultiModalEncoder(space, 8, fusion=Recording, fusion_kwargs={"stages": stages, "amount": 1.0})
    assert list(encoder.fusions) == list(chosen)
    plain = MultiModalEncoder(space, 8)
    plain.load_state_dict(encoder.state_dict())
    assert not th.allclose(encoder(sampled(space)), plain(sampled(space)), atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stages", ["last", "all"])
def test_encoder_with_fusion(name: str, stages: str) -> None:
    """Features of each modality depend on the others, gradients reach all of the encoders and fusions."""
    space = two_images(names="rgb event depth")
    th.manual_seed(0)
    encoder = MultiModalEncoder(space, 8, precision="float32", fusion=name, fusion_kwargs={"stages": stages})
    for parameter in encoder.fusions.parameters():
        parameter.data.add_(th.randn_like(parameter), alpha=0.1)
    observations = sampled(space)
    features = encoder(observations)
    assert features.shape == (4, 3, 8)
    for key in space:
        moved = encoder({**observations, key: 255 - observations[key]}) - features
        assert (moved.abs().amax(dim=2) > 1e-5).all(), key
    (features * th.randn_like(features)).sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


@pytest.mark.parametrize(
    "kwargs,message",
    [
        ({"fusion": "mean"}, "fusion='mean': expected \"concat\", one of"),
        ({"fusion_kwargs": {"stages": "all"}}, "takes no fusion_kwargs"),
        ({"fusion": "efnet", "fusion_kwargs": {"stages": [3]}}, "numbers 0 to 2"),
        ({"fusion": "efnet", "fusion_kwargs": {"stages": []}}, "numbers 0 to 2"),
        ({"fusion": "efnet", "fusion_kwargs": {"stages": "first"}}, "stages='first'"),
        ({"fusion": "transfuser", "fusion_kwargs": {"n_heads": 5}}, "64 channels cannot be divided among 5 heads"),
        ({"fusion": "efnet", "fusion_kwargs": {"n_heads": 5}}, "64 channels cannot be divided among 5 heads"),
        ({"fusion": "efnet", "encoder_classes": {"rgb": NatureCNN}}, "modality 'rgb': CrossModalChannelAttention"),
        (
            {"fusion": "efnet", "encoder_kwargs": {"rgb": {"layers": [(4, 3, 2)]}}},
            "same number of stages, got .*'rgb': 1",
        ),
    ],
)
def test_errors_name_the_remedy(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MultiModalEncoder(two_images(), 8, **kwargs)


class Brighter(ImageEncoder):
    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations + 1)


class BrighterByStages(Brighter):
    @property
    def stages(self) -> list[th.nn.Module]:
        first, *others = super().stages
        return [th.nn.Sequential(Shift(), first), *others]


class Shift(th.nn.Module):
    def forward(self, observations: th.Tensor) -> th.Tensor:
        return observations + 1


class SubclassOfBrighter(Brighter):
    """Its parent's ``forward`` is bypassed as well."""


@pytest.mark.parametrize("encoder_class", [Brighter, SubclassOfBrighter])
def test_encoder_whose_forward_would_be_bypassed(encoder_class: type[ImageEncoder]) -> None:
    encoder_classes = {"event": encoder_class}
    with pytest.raises(ValueError, match=rf"modality 'event': {encoder_class.__name__} overrides `forward`"):
        MultiModalEncoder(two_images(), 8, encoder_classes=encoder_classes, fusion="efnet")
    MultiModalEncoder(two_images(), 8, encoder_classes=encoder_classes)


def test_encoder_with_stages_of_its_own() -> None:
    space = two_images()
    kwargs: Any = {"encoder_classes": dict.fromkeys(space, BrighterByStages), "precision": "float32"}
    th.manual_seed(0)
    plain, fused = MultiModalEncoder(space, 8, **kwargs), MultiModalEncoder(space, 8, fusion=Recording, **kwargs)
    fused.load_state_dict(plain.state_dict())
    assert th.equal(plain(sampled(space)), fused(sampled(space)))


def test_vectors_cannot_be_fused() -> None:
    space = spaces.Dict({**two_images().spaces, "state": spaces.Box(-1, 1, (4,), np.float32)})
    with pytest.raises(ValueError, match=r"modality 'state': Transfuser fuses.*shape \(4,\).*`modalities`"):
        MultiModalEncoder(space, 8, fusion="transfuser")
    without = {"rgb": ["rgb"], "event": ["event"]}
    assert MultiModalEncoder(space, 8, fusion="transfuser", modalities=without)(sampled(space)).shape == (4, 2, 8)


def test_own_fusion_must_keep_the_shapes() -> None:
    class Halving(FeatureFusion):
        def forward(self, maps: Sequence[th.Tensor]) -> list[th.Tensor]:
            return [values[:, ::2] for values in maps]

    with pytest.raises(ValueError, match="Halving returned maps of the shapes"):
        MultiModalEncoder(two_images(), 8, fusion=Halving)(sampled(two_images()))


SMALL = {key: {"layers": [(8, 5, 3), (8, 3, 2)]} for key in ("rgb", "event")}


def fused_model(fusion: Any, **kwargs: Any) -> HAVESAC:
    policy_kwargs = {"fusion": fusion, "encoder_kwargs": SMALL, **kwargs.pop("policy_kwargs", {})}
    space = spaces.Dict({"rgb": image(3), "event": image(5)})
    model = tiny_model(space, policy_kwargs, learning_rate=1e-3, **kwargs)
    fill_buffer(model, 30)
    return model


@pytest.mark.parametrize("value_estimation", ["have", "gve"])
@pytest.mark.parametrize("fusion", [*NAMES, Recording])
def test_havesac_trains_and_comes_back(fusion: Any, value_estimation: str, tmp_path: Path) -> None:
    """Critic's optimizer and target's average cover the fusion; a saved model goes on to the same bits."""
    kwargs: dict[str, Any] = {"fusion_kwargs": {"stages": "all", **({"amount": 0.1} if fusion is Recording else {})}}
    model = fused_model(fusion, value_estimation=value_estimation, policy_kwargs=kwargs)
    critic, target = model.critic.encoder.fusions, model.critic_target.encoder.fusions
    before, before_target = clone_parameters(critic), clone_parameters(target)
    assert before.keys() == before_target.keys()
    assert all(th.equal(value, before_target[name]) for name, value in before.items())
    model.train(3, batch_size=8)
    assert changed(before, critic) == set(before) and changed(before_target, target) == set(before)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.set_logger(quiet_logger())
    assert type(loaded.critic.encoder.fusions["0"]) is type(critic["0"]) and list(loaded.critic.encoder.fusions) == [
        "0",
        "1",
    ]
    observation = batched(model.observation_space.sample())
    for _ in range(2):
        actions = [one.predict(observation, deterministic=True)[0] for one in (model, loaded)]
        assert np.array_equal(actions[0], actions[1])
        for one in (model, loaded):
            np.random.seed(0)
            th.manual_seed(0)
            one.train(1, batch_size=8)


def test_extractor_takes_a_fusion() -> None:
    extractor = MultiModalExtractor(two_images(), 8, fusion="efnet", precision="float32")
    observations = sampled(two_images())
    assert th.equal(extractor(observations), extractor.encoder(observations).flatten(1))
    assert extractor.features_dim == 16 and list(extractor.encoder.fusions) == ["2"]
