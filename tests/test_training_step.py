"""How a training step is carried out: how often, in which arithmetic, what waits for what (losses: test_have_math)."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import RandomSensors, changed, clone_parameters, fill_buffer, image, sensors_space, tiny_model, vectors_space
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_have import HAVESAC, ModalityReplayBuffer
from sb3_have.common import encoders
from sb3_have.common.encoders import ImageEncoder, MultiModalEncoder, decode_bytes

# -- Schedules


@pytest.mark.parametrize("calls", [[6], [1] * 6, [2, 1, 3]], ids=str)
def test_policy_delay(calls: list[int]) -> None:
    """Actor and temperature move in every third update of the whole training, critics in each."""
    model = tiny_model(vectors_space(), policy_delay=3, ent_coef="auto")
    fill_buffer(model, 30)
    assert model.log_ent_coef is not None
    actor_steps, critic_steps = 0, 0
    for gradient_steps in calls:
        actor, critic = clone_parameters(model.actor), clone_parameters(model.critic)
        temperature = model.log_ent_coef.detach().clone()
        due = any(update % 3 == 0 for update in range(model._n_updates + 1, model._n_updates + gradient_steps + 1))
        model.train(gradient_steps, 8)
        assert bool(changed(actor, model.actor)) is due
        assert (not th.equal(temperature, model.log_ent_coef)) is due
        assert changed(critic, model.critic)
    actor_steps, critic_steps = (
        int(next(iter(optimizer.state.values()))["step"])
        for optimizer in (model.actor.optimizer, model.critic.optimizer)
    )
    assert (actor_steps, critic_steps) == (2, 6)


@pytest.mark.parametrize("name", ["buffer_size", "policy_delay", "target_update_interval"])
@pytest.mark.parametrize("number", [0, -1, 1.5, 1e3])
def test_numbers_that_make_no_sense(name: str, number: float) -> None:
    with pytest.raises(ValueError, match=f"{name}={number}: expected a whole number"):
        tiny_model(vectors_space(), None, **{name: number})


# -- Bytes to numbers


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("channels", [1, 5])
@pytest.mark.parametrize("key", ["rgb", "event"])
def test_decoding_by_table_is_decoding_by_arithmetic(key: str, channels: int, precision: str) -> None:
    """Every byte, in every memory format, to the same bits."""
    space = spaces.Dict({key: spaces.Box(0, 255, (channels, 16, 20), np.uint8)})
    encoder = MultiModalEncoder(space, features_dim=4, precision=precision)
    generator = th.Generator().manual_seed(0)
    images = th.randint(256, (3, channels, 16, 20), dtype=th.uint8, generator=generator)
    images[0].view(-1)[:256] = th.arange(256)
    dtype = getattr(th, precision)
    expected = decode_bytes(images, signed=key == "event").to(dtype)
    for given in (images, images.contiguous(memory_format=th.channels_last), images.transpose(2, 3).clone().mT):
        decoded = encoder._decode(key, given, True, dtype)
        assert decoded.dtype == dtype and decoded.is_contiguous(memory_format=th.channels_last)
        assert th.equal(decoded, expected)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize(("layer", "height", "width"), [((4, 8, 4), 36, 44), ((4, 4, 2), 16, 20), ((4, 16, 8), 32, 40)])
def test_blocks_give_the_features_and_gradients_of_pixels(
    layer: tuple[int, int, int], height: int, width: int, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Space to depth is only another order of the same sums."""
    space = spaces.Dict({key: spaces.Box(0, 255, (3, height, width), np.uint8) for key in ("rgb", "event")})
    images = {key: th.as_tensor(space[key].sample()[None]).expand(2, -1, -1, -1) for key in space}
    results = []
    for has_avx512 in (True, False):
        monkeypatch.setattr(encoders, "has_avx512", lambda has=has_avx512: has)
        th.manual_seed(0)
        kwargs = {key: {"layers": [layer]} for key in space}
        encoder = MultiModalEncoder(space, features_dim=4, encoder_kwargs=kwargs, precision=precision)
        assert [module.block_size for module in encoder.encoders] == [layer[2] if has_avx512 else 1] * 2
        features = encoder(images)
        (features * th.tensor([1.0, -2.0, 0.5, 3.0])).sum().backward()
        results.append((features, *(parameter.grad for parameter in encoder.parameters())))
    tolerance = {"float32": 1e-4, "bfloat16": 2e-2}[precision]
    for blocks, pixels in zip(*results, strict=True):
        assert blocks is not None and pixels is not None
        th.testing.assert_close(blocks, pixels, rtol=tolerance, atol=tolerance * float(pixels.detach().abs().max()))


@pytest.mark.parametrize(("layer", "size"), [((4, 3, 2), 32), ((4, 8, 4), 38), ((4, 4, 4), 32), ((4, 3, 1), 32)])
def test_what_cannot_be_read_in_blocks_is_read_in_pixels(
    layer: tuple[int, int, int], size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(encoders, "has_avx512", lambda: True)
    assert ImageEncoder(spaces.Box(0, 255, (3, size, size), np.uint8), 4, [layer]).block_size == 1


def test_an_encoder_without_convolutions() -> None:
    encoder = ImageEncoder(spaces.Box(0, 255, (3, 8, 8), np.uint8), 4, layers=[])
    assert encoder.block_size == 1 and encoder(th.zeros(2, 3, 8, 8)).shape == (2, 4)


def test_grouped_images_and_own_encoders_are_read_in_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A subclass may expect pixels, and the channels of two images are joined behind one another."""

    class Own(ImageEncoder):
        def forward(self, observations: th.Tensor) -> th.Tensor:
            assert observations.shape[1:] == (3, 36, 36)
            return super().forward(observations)

    space = spaces.Dict({key: spaces.Box(0, 255, (3, 36, 36), np.uint8) for key in ("a", "b", "c")})
    images = {key: th.as_tensor(space[key].sample()[None]) for key in space}
    modalities, features = {"ab": ["a", "b"], "c": ["c"]}, []
    for has_avx512 in (True, False):
        monkeypatch.setattr(encoders, "has_avx512", lambda has=has_avx512: has)
        th.manual_seed(0)
        encoder = MultiModalEncoder(space, 4, modalities, encoder_classes={"c": Own}, precision="float32")
        features.append(encoder(images))
    assert th.equal(*features)


def test_what_bytes_stand_for() -> None:
    values = th.tensor([0, 1, 127, 128, 129, 255], dtype=th.uint8)
    assert decode_bytes(values, signed=True).tolist() == [0, -127 / 8, -1 / 8, 0, 1 / 8, 127 / 8]
    np.testing.assert_allclose(decode_bytes(values, signed=False), values.numpy() / 255, rtol=1e-6)


def test_encoder_can_be_exported() -> None:
    """The table is not part of the graph, and the numbers are the same."""
    space = spaces.Dict({key: spaces.Box(0, 255, (3, 36, 36), np.uint8) for key in ("rgb", "event")})
    encoder = MultiModalEncoder(space, features_dim=4, precision="float32")
    generator = th.Generator().manual_seed(0)
    observations = {key: th.randint(256, (2, 3, 36, 36), dtype=th.uint8, generator=generator) for key in space.spaces}
    batch = th.export.Dim("batch")
    shapes = ({key: {0: batch} for key in space.spaces},)
    exported = th.export.export(encoder, (observations,), dynamic_shapes=shapes).module()
    for n in (1, 2):
        given = {key: value[:n] for key, value in observations.items()}
        with th.no_grad():
            th.testing.assert_close(exported(given), encoder(given))


def test_arithmetic_is_announced_once(capsys: pytest.CaptureFixture[str]) -> None:
    model = tiny_model(sensors_space(), {"precision": "bfloat16"}, verbose=1)
    fill_buffer(model, 20)
    model.train(2, 8)
    assert capsys.readouterr().out.count("bfloat16") == 1


# -- What the host waits for


class ReadsOfTensors(TorchDispatchMode):
    """
    Counts the times that Python asks for a tensor's value: on a GPU the host waits for it.

    :param on_host: a tensor that does not count
    """

    def __init__(self, on_host: th.Tensor):
        super().__init__()  # type: ignore[no-untyped-call]
        self.on_host, self.count = on_host, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is th.ops.aten._local_scalar_dense.default:
            self.count += args[0].data_ptr() != self.on_host.data_ptr()
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"modality_dropout": 0.3, "policy_delay": 2},
        {"target": "paper"},
        {"random_shift": 4, "n_augmentations": 2},
    ],
    ids=str,
)
def test_no_update_reads_a_tensor(monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]) -> None:
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", False)  # as on a GPU
    model = tiny_model(sensors_space(), **options)
    fill_buffer(model, 30)
    model.train(2, 8)
    assert model.ent_coef_optimizer is not None
    (temperature_state,) = model.ent_coef_optimizer.state.values()
    counts = []
    for gradient_steps in (2, 6):
        with ReadsOfTensors(on_host=temperature_state["step"]) as reads:  # on the host for a GPU's parameters too
            model.train(gradient_steps, 8)
        counts.append(reads.count)
    assert counts[0] == counts[1] > 0  # the means of the losses, once


def test_losses_are_read_when_logs_are_dumped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not on a CPU, where nothing is gained."""
    model = tiny_model(vectors_space())
    fill_buffer(model, 30)
    model.train(1, 8)
    on_cpu = model.logger.name_to_value["train/critic_loss"]
    assert isinstance(on_cpu, float) and on_cpu > 0

    model = tiny_model(vectors_space())
    fill_buffer(model, 30)
    model.device = th.device("cuda")  # only what `train` makes of it
    model.train(1, 8)
    assert isinstance(model.logger.name_to_value["train/critic_loss"], th.Tensor)
    dumped: dict[str, Any] = {}
    monkeypatch.setattr(type(model.logger), "dump", lambda self, step: dumped.update(self.name_to_value))
    model.start_time, model.ep_info_buffer, model.ep_success_buffer = 0, [], []
    model.dump_logs()
    assert type(dumped["train/critic_loss"]) is float and dumped["train/critic_loss"] == on_cpu


def test_nan_in_the_actor_is_an_error_on_a_cpu() -> None:
    model = tiny_model(vectors_space())
    with th.no_grad():
        model.actor.mu.bias.fill_(th.nan)  # type: ignore[operator]
    with pytest.raises(ValueError, match="invalid values"):
        model.predict(model.observation_space.sample())


# -- Compilation


@pytest.mark.filterwarnings("ignore:.*script_method:DeprecationWarning")  # PyTorch's own, on the compiler's import
def test_compile(tmp_path: Any) -> None:
    """The compiled modules are called, have the same names, and a loaded model has them too."""
    space = sensors_space()
    plain, model = (tiny_model(space, compile=compiled) for compiled in (False, True))
    assert plain.policy.state_dict().keys() == model.policy.state_dict().keys()
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", env=RandomSensors(space))
    with th.compiler.set_stance("force_eager"):  # a compiler's minutes are not for the test suite
        for trained in (plain, model, loaded):
            fill_buffer(trained, 30)
            th.manual_seed(0)
            np.random.seed(0)
            trained.train(2, 8)
    for trained in (model, loaded):
        modules = [*trained.critic.children(), *trained.critic_target.children(), *trained.policy.auxiliary.values()]
        assert len(modules) == 11 and all(module._compiled_call_impl is not None for module in modules)
        assert not changed(clone_parameters(plain.policy), trained.policy)
    assert all(module._compiled_call_impl is None for module in plain.critic.children())


# -- Which replay buffer


@pytest.mark.parametrize(
    "space, n_steps, expected",
    [
        (sensors_space(), 1, "ModalityReplayBuffer"),
        (image(3), 1, "ModalityReplayBuffer"),
        (vectors_space(), 1, "DictReplayBuffer"),
        (vectors_space(), 3, "ModalityReplayBuffer"),
        (spaces.Box(-1, 1, (4,)), 1, "ReplayBuffer"),
    ],
    ids=["images", "image", "vectors", "n-step", "vector"],
)
def test_replay_buffer_by_default(space: spaces.Space[Any], n_steps: int, expected: str) -> None:
    model = tiny_model(space, n_steps=n_steps)
    assert type(model.replay_buffer).__name__ == expected
    assert model.n_steps == n_steps and model.replay_buffer_kwargs == {}


def test_n_steps_and_gamma_reach_the_replay_buffer() -> None:
    model = tiny_model(vectors_space(), n_steps=3, gamma=0.7)
    assert isinstance(model.replay_buffer, ModalityReplayBuffer)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 0.7)
    own = tiny_model(sensors_space(), replay_buffer_class=ModalityReplayBuffer, replay_buffer_kwargs={"n_steps": 2})
    assert isinstance(own.replay_buffer, ModalityReplayBuffer) and own.replay_buffer.n_steps == 2


def test_model_loaded_without_environment_knows_the_stack(tmp_path: Any) -> None:
    """Its replay buffer, made for an environment that may come later, would take three times the memory."""
    model = tiny_model(sensors_space(), env=VecFrameStack(DummyVecEnv([lambda: RandomSensors(sensors_space())]), 3))
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model")
    assert isinstance(loaded.replay_buffer, ModalityReplayBuffer) and loaded.replay_buffer.n_stack == 3


# -- For programs that train


def test_freed_memory_is_kept() -> None:
    """In a process of its own: allocating the same again brings no page faults."""
    program = """
import resource, sys
import numpy as np
from sb3_have.common.memory import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit(3)
faults = []
for _ in range(4):
    np.ones(10_000_000)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[0])
"""
    results = {
        name: subprocess.run([sys.executable, "-c", program, name], capture_output=True, text=True, check=False)
        for name in ("default", "keep")
    }
    if results["keep"].returncode == 3:
        pytest.skip("the C library has no mallopt")
    assert int(results["keep"].stdout) < 100 < int(results["default"].stdout), results


def test_tensors_of_other_callbacks_stay_in_the_logger(monkeypatch: pytest.MonkeyPatch) -> None:
    """SB3 writes them as histograms."""
    model = tiny_model(vectors_space())
    fill_buffer(model, 30)
    model.train(1, 8)
    model.logger.record("weights", th.ones(3))
    dumped: dict[str, Any] = {}
    monkeypatch.setattr(type(model.logger), "dump", lambda self, step: dumped.update(self.name_to_value))
    model.start_time, model.ep_info_buffer, model.ep_success_buffer = 0, [], []  # type: ignore[assignment]
    model.dump_logs()
    assert th.equal(dumped["weights"], th.ones(3))
