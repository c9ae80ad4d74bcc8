"""DrQ's random shifts, and the averages over differently shifted copies in a training step."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs import (
    FixedBatch,
    RandomSensors,
    changed,
    clone_parameters,
    fill_buffer,
    image,
    sensors_space,
    tiny_model,
    vectors_space,
)
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_have import HAVESAC
from sb3_have.common.augmentation import random_shift, shift_images, shifted_copies
from sb3_have.have import have
from sb3_have.have.auxiliary import LatentTransitions

# -- One shift


def crop_of_padded(image: np.ndarray, pixels: int, dy: int, dx: int) -> np.ndarray:
    """DrQ's own words: replicate the edge of (C, H, W) by ``pixels``, then crop."""
    height, width = image.shape[1:]
    padded = np.pad(image, ((0, 0), (pixels, pixels), (pixels, pixels)), mode="edge")
    return padded[:, pixels + dy : pixels + dy + height, pixels + dx : pixels + dx + width]


@pytest.mark.parametrize("layout", ["contiguous", "channels_last", "transposed"])
@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
@pytest.mark.parametrize("shape", [(9, 12, 17), (1, 8, 5)])
def test_shift_is_a_crop_of_the_padded_image(shape: tuple[int, int, int], dtype: th.dtype, layout: str) -> None:
    """Every shift up to 4 pixels, of three images and as many copies as that takes."""
    generator = th.Generator().manual_seed(0)
    images = th.randint(256, (3, *shape), generator=generator).to(dtype)
    given = {
        "contiguous": images,
        "channels_last": images.contiguous(memory_format=th.channels_last),
        "transposed": images.transpose(2, 3).clone().transpose(2, 3),
    }[layout]
    shifts = th.cartesian_prod(th.arange(-4, 5), th.arange(-4, 5))
    moved = shift_images(given, shifts)
    assert moved.dtype == dtype and moved.is_contiguous() and moved.shape == (81, *shape)
    for i, (dy, dx) in enumerate(shifts.tolist()):
        np.testing.assert_array_equal(moved[i].numpy(), crop_of_padded(images[i % 3].numpy(), 4, dy, dx))
    assert th.equal(given, images)  # the replay buffer's own memory stays as it is


def maps(n: int, channels: int, size: int = 15) -> th.Tensor:
    """Images (n, channels, size, size) whose every pixel holds its own place, and every channel the same."""
    return th.arange(size * size, dtype=th.uint8).view(1, 1, size, size).repeat(n, channels, 1, 1)


def shifts_of(images: th.Tensor, size: int = 15) -> np.ndarray:
    """(n, 2), read from the middle of the first channel of :func:`maps`."""
    middle = images[:, 0, size // 2, size // 2].long().numpy()
    return np.stack([middle // size, middle % size], axis=1) - size // 2


def test_every_sensor_and_frame_of_a_sample_moves_alike() -> None:
    th.manual_seed(0)
    state = th.randn(1000, 3)
    moved = random_shift({"rgb": maps(1000, 9), "state": state, "event": maps(1000, 15)}, 4, n_copies=3)
    assert isinstance(moved, dict) and list(moved) == ["rgb", "state", "event"]
    assert th.equal(moved["rgb"][:, :1].expand(-1, 15, -1, -1), moved["event"])
    assert th.equal(moved["rgb"], moved["rgb"][:, :1].expand(-1, 9, -1, -1))
    assert th.equal(moved["state"], th.cat([state] * 3))
    shifts = shifts_of(moved["rgb"]).reshape(3, 1000, 2)
    for a, b in [(shifts[0], shifts[1]), (shifts[0], shifts[2]), (shifts[0, 1:], shifts[0, :-1])]:
        assert 0 < (a == b).all(axis=1).mean() < 0.03  # 1 in 81 by chance


@pytest.mark.parametrize("pixels, critical", [(1, 26.1), (2, 51.2), (4, 124.8)])
def test_every_shift_is_as_likely_as_every_other(pixels: int, critical: float) -> None:
    """Chi-square over the (2 p + 1)^2 shifts; ``critical`` is the 99.9% quantile."""
    th.manual_seed(0)
    n, side = 200 * (2 * pixels + 1) ** 2, 2 * pixels + 1
    moved = random_shift(maps(n, 1), pixels)
    assert isinstance(moved, th.Tensor)
    cells = (shifts_of(moved) + pixels) @ [side, 1]
    counts = np.bincount(cells, minlength=side**2)
    assert len(counts) == side**2 and counts.sum() == n
    assert ((counts - 200) ** 2 / 200).sum() < critical


def test_the_seed_decides() -> None:
    images = th.randint(256, (20, 3, 12, 12), dtype=th.uint8)
    results = []
    for seed in (3, 3, 4):
        th.manual_seed(seed)
        results.append(random_shift(images, 2))
    assert th.equal(results[0], results[1])  # type: ignore[arg-type]
    assert not th.equal(results[0], results[2])  # type: ignore[arg-type]


@pytest.mark.parametrize("discounts", [None, th.rand(6, 1)], ids=["one step", "n steps"])
def test_copies_of_a_batch(discounts: th.Tensor | None) -> None:
    """What is no image is repeated; observations and next observations move independently."""
    th.manual_seed(0)
    numbers = [th.rand(6, 2), th.rand(6, 1), th.rand(6, 1)]
    samples = DictReplayBufferSamples(
        {"rgb": maps(6, 3)}, numbers[0], {"rgb": maps(6, 3)}, numbers[1], numbers[2], discounts=discounts
    )
    copies = shifted_copies(samples, 4, 50)
    assert not th.equal(copies.observations["rgb"], copies.next_observations["rgb"])
    same = (shifts_of(copies.observations["rgb"]) == shifts_of(copies.next_observations["rgb"])).all(axis=1)
    assert same.mean() < 0.1
    for name in ("actions", "dones", "rewards", "discounts"):
        value, copied = getattr(samples, name), getattr(copies, name)
        assert (copied is None) if value is None else th.equal(copied, th.cat([value] * 50)), name
    single = shifted_copies(ReplayBufferSamples(maps(6, 3), numbers[0], maps(6, 3), numbers[1], numbers[2]), 4)
    assert isinstance(single, ReplayBufferSamples) and single.observations.shape == (6, 3, 15, 15)


# -- In training


def trained(monkeypatch: pytest.MonkeyPatch, copies: int, **kwargs: Any) -> tuple[HAVESAC, Any, list[Any]]:
    """
    A model after one step on a fixed batch of 4 with learning rate 0.

    :return: the model, the copies that it saw, and what its actor drew: at the next observations, at the observations
    """
    model = tiny_model(
        sensors_space(), learning_rate=0.0, tau=0.0, ent_coef=0.3, gamma=0.9, replay_buffer_class=FixedBatch,
        random_shift=3, n_augmentations=copies, **kwargs,
    )  # fmt: skip
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.05 * th.randn_like(parameter))
    fill_buffer(model, 20)
    assert isinstance(model.replay_buffer, FixedBatch)
    model.replay_buffer.batch = super(FixedBatch, model.replay_buffer).sample(4)
    seen: list[Any] = []
    drawn: list[Any] = []

    def see(*args: Any) -> Any:
        seen.append(shifted_copies(*args))
        return seen[-1]

    def draw(features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        actions, log_prob = action_log_prob(features)
        drawn.append((actions, log_prob))
        return actions, log_prob

    action_log_prob = model.actor.action_log_prob
    monkeypatch.setattr(have, "shifted_copies", see)
    monkeypatch.setattr(model.actor, "action_log_prob", draw)
    model.train(1, 4)
    return model, seen[0], drawn


@pytest.mark.parametrize("target", ["bellman", "paper"])
@pytest.mark.parametrize("copies", [1, 2, 3])
def test_target_and_loss_are_means_over_the_copies(monkeypatch: pytest.MonkeyPatch, copies: int, target: str) -> None:
    """Copy by copy; DeepMDP and the actor take the first; the gradients too."""
    model, seen, ((next_actions, next_log_prob), (actions_pi, log_prob)) = trained(
        monkeypatch, copies, target=target, refusion="monotone", local_coef=0.5
    )
    batch = model.replay_buffer.batch  # type: ignore[union-attr]
    parts = [slice(4 * m, 4 * m + 4) for m in range(copies)]
    rewards, goes_on = batch.rewards[:, 0], 1 - batch.dones[:, 0]

    with th.no_grad():
        targets = []
        for part in parts:
            z = model.critic_target.encoder({key: value[part] for key, value in seen.next_observations.items()})
            values, entropy = model.critic_target.values(z, next_actions[part]), -0.3 * next_log_prob[part]
            q_g, q_l = values.q_global, values.q_lve
            assert q_g is not None and q_l is not None
            if target == "paper":
                y_g, y_l = (rewards + 0.9 * goes_on * (q + entropy) for q in (q_g, q_l))
                targets.append(model.critic_target.refusion(y_g, y_l, z).min(dim=0).values)
            else:
                targets.append(rewards + 0.9 * goes_on * (th.minimum(*values.q) + entropy))
        y = sum(targets) / copies
    losses, features = [], []
    for part in parts:
        features.append(model.policy.encode({key: value[part] for key, value in seen.observations.items()}))
        values = model.critic.values(features[-1], batch.actions)
        assert values.q_global is not None and values.q_lve is not None and values.q_local is not None
        loss = th.tensor(0.0)
        for k in range(2):
            for weight, q in [(1, values.q[k]), (0.5, values.q_global[k]), (0.5, values.q_lve[k])]:
                loss = loss + weight * 0.5 * ((q - y) ** 2).mean()
            loss = loss + 0.5 * 0.5 * ((values.q_local[k] - y) ** 2).mean()
        losses.append(loss)
    critic_loss = th.stack(losses).mean()
    logged = model.logger.name_to_value
    assert logged["train/critic_loss"] == pytest.approx(float(critic_loss.detach()), rel=1e-4)
    assert copies == 1 or not th.allclose(losses[0], losses[1], rtol=1e-3)

    z_next = model.critic_target.encoder({key: value[:4] for key, value in seen.next_observations.items()})
    predicted = model.policy.auxiliary["deepmdp"](
        LatentTransitions(features[0], batch.actions, batch.rewards, z_next.detach(), batch.dones)
    )
    assert logged["train/aux_transition_loss"] == pytest.approx(float(predicted["transition"].detach()), rel=1e-4)
    assert logged["train/aux_reward_loss"] == pytest.approx(float(predicted["reward"].detach()), rel=1e-4)
    assert len(actions_pi) == 4
    with th.no_grad():
        q_pi = model.critic.values(features[0], actions_pi).q
    actor_loss = (0.3 * log_prob.detach() - th.minimum(*q_pi)).mean()
    assert logged["train/actor_loss"] == pytest.approx(float(actor_loss), rel=1e-4)

    parameters = [*model.critic.parameters(), *model.policy.auxiliary.parameters()]
    expected = th.autograd.grad(critic_loss + predicted["transition"] + predicted["reward"], parameters)
    for parameter, gradient in zip(parameters, expected, strict=True):
        assert parameter.grad is not None and gradient.any()
        assert th.allclose(parameter.grad, gradient, rtol=1e-3, atol=1e-5 * float(gradient.abs().max()) + 1e-7)


def test_without_shift_nothing_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """The encoders get the very tensors of the replay buffer's sample, and nothing more is drawn."""
    model = tiny_model(sensors_space(), replay_buffer_class=FixedBatch)
    fill_buffer(model, 20)
    assert isinstance(model.replay_buffer, FixedBatch)
    batch = model.replay_buffer.batch = super(FixedBatch, model.replay_buffer).sample(4)
    given: list[Any] = []
    for critic in (model.critic, model.critic_target):
        critic.encoder.register_forward_pre_hook(lambda module, args: given.append(args[0]))
    model.train(1, 4)
    assert len(given) == 2 and given[0] is batch.observations and given[1] is batch.next_observations


def test_shifts_change_what_is_learnt_and_the_seed_repeats_it() -> None:
    policies = []
    for pixels, copies in [(0, 1), (4, 2), (4, 2), (4, 1)]:
        model = tiny_model(sensors_space(), random_shift=pixels, n_augmentations=copies)
        fill_buffer(model, 30)
        th.manual_seed(0)
        np.random.seed(0)
        model.train(2, 8)
        policies.append(model.policy)
    plain, two, again, one = (clone_parameters(policy) for policy in policies)
    assert not changed(two, policies[2]) and not changed(again, policies[1])
    encoders = {name for name in plain if name.startswith("critic.encoder")}
    for policy in policies[1], policies[3]:
        assert changed(plain, policy) >= {name for name in encoders if ".convolutions." in name}
    assert changed(one, policies[1])


def test_options_are_saved_and_frames_move_together(tmp_path: Path) -> None:
    env = VecFrameStack(DummyVecEnv([lambda: RandomSensors(sensors_space())]), 3)
    model = tiny_model(sensors_space(), env=env, random_shift=4, n_augmentations=2, n_steps=2)
    model.learn(12)
    assert model._n_updates > 0
    model.save(tmp_path / "model")
    loaded = HAVESAC.load(tmp_path / "model", device="cpu")
    assert (loaded.random_shift, loaded.n_augmentations) == (4, 2)


def test_a_single_image_without_dictionary() -> None:
    model = tiny_model(image(3), random_shift=4, n_augmentations=2)
    fill_buffer(model, 20)
    before = clone_parameters(model.critic.encoder)
    model.train(1, 8)
    assert changed(before, model.critic.encoder) == set(before)


# -- Options that make no sense


@pytest.mark.parametrize(
    "options, message",
    [
        ({"random_shift": -1}, "random_shift=-1: expected a whole number >= 0"),
        ({"random_shift": 2.0}, "random_shift=2.0: expected a whole number"),
        ({"random_shift": True}, "random_shift=True: expected a whole number"),
        ({"random_shift": 4, "n_augmentations": 0}, "n_augmentations=0: expected a whole number >= 1"),
        ({"random_shift": 4, "n_augmentations": 1.5}, "n_augmentations=1.5: expected a whole number"),
        ({"n_augmentations": 2}, "n_augmentations=2 with random_shift=0: all copies would be the same"),
        ({"random_shift": 36}, "random_shift=36: observation key '(rgb|event)' has only 36x36 pixels"),
    ],
    ids=str,
)
def test_options_that_make_no_sense(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tiny_model(sensors_space(), **options)


def test_every_shift_that_leaves_a_pixel() -> None:
    assert tiny_model(sensors_space(), random_shift=35).random_shift == 35


def test_nothing_to_shift() -> None:
    with pytest.raises(ValueError, match="random_shift=4: there are no images"):
        tiny_model(vectors_space(), random_shift=4)
