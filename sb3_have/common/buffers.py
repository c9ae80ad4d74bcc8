"""Replay buffer for stacked images that stores every frame once."""

import os
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_have.common.frames import EMPTY, FramePool

Observation = np.ndarray | dict[str, np.ndarray]


class ModalityReplayBuffer(ReplayBuffer):
    """
    Replay buffer for Dict observations (or a Box) with n-step returns, which needs a fraction of the memory of SB3's
    ``DictReplayBuffer`` and ``ReplayBuffer``.

    A stack of k frames shares k - 1 of them with the next one, and ``next_obs`` is the following ``obs``, so this
    buffer stores each frame once, and 2 k slot numbers for a transition. A stack that does not continue the last one
    (after a reset, a truncation, loading the buffer, or a wrapper that changes it) is stored separately. Therefore
    samples are exactly those of SB3's buffers, whatever is added and whatever ``n_stack`` is, which only changes the
    memory used. The buffer always holds ``buffer_size`` transitions. Indices are drawn as in SB3, so the same seed
    gives the same batch.

    It also works with SB3's algorithms: ``SAC("MultiInputPolicy", env, replay_buffer_class=ModalityReplayBuffer,
    replay_buffer_kwargs=dict(n_stack=stacked_frames(env)))``.

    SB3's issues #37 and #1936 and its pull request #243 ask for both features for Dict observations.

    :param buffer_size: Max number of transitions in the buffer, over all environments
    :param observation_space: Dict of Boxes or other array-valued spaces, or a Box; uint8 images (kC, H, W) are split
        into k frames, and every other key is stored once per step
    :param action_space: Action space
    :param device: PyTorch device to which samples are moved
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Must be False, because frames are stored once anyway
    :param handle_timeout_termination: Handle timeout termination (due to time limit) separately, as in SB3
    :param n_stack: Number of frames in a stacked image (k), see :func:`stacked_frames`; HAVESAC sets it
    :param n_steps: Number of steps of n-step returns. They stop at the end of the episode, at the last transition
        written, and where observations do not continue.
    :param gamma: Discount factor of n-step returns
    :param storage: "memory", "mmap" (temporary files, for more frames than fit into memory) or "device" (frames on the
        device, where CUDA gathers them without the host)
    :param mmap_dir: Directory for the files of "mmap"; by default the system's directory for temporary files
    :raises ValueError: for invalid arguments. Memory is reserved when the first transition is added, which can raise
        MemoryError, or OSError if the disk is full.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_stack: int = 1,
        n_steps: int = 1,
        gamma: float = 0.99,
        storage: str = "memory",
        mmap_dir: str | os.PathLike[str] | None = None,
    ):
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage=True: leave it False, because this buffer stores every frame once anyway."
            )
        if n_stack < 1 or n_steps < 1:
            raise ValueError(f"n_stack={n_stack}, n_steps={n_steps}: expected whole numbers >= 1.")
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_stack, self.n_steps, self.gamma = n_stack, n_steps, gamma

        self.shapes: dict[str, tuple[int, ...]] = (
            self.obs_shape if isinstance(self.obs_shape, dict) else {"observation": self.obs_shape}
        )
        subspaces = observation_space.spaces if isinstance(observation_space, spaces.Dict) else None
        frame_shapes, dtypes, self.stacked_keys = {}, {}, []
        for key, shape in self.shapes.items():
            space = observation_space if subspaces is None else subspaces[key]
            dtypes[key] = np.dtype(space.dtype)
            frame_shapes[key] = shape
            if is_image_space(space) and np.argmin(shape) == 0 and shape[0] % n_stack == 0:  # channels first
                frame_shapes[key] = (shape[0] // n_stack, *shape[1:])
                self.stacked_keys.append(key)

        n_slots = 1 + self.n_envs * (self.buffer_size + self.buffer_size // 32 + n_stack + 1)
        self.pool = FramePool(n_slots, frame_shapes, dtypes, storage, self.device, mmap_dir)
        self.slots = np.full((self.buffer_size, self.n_envs, 2, n_stack), EMPTY, np.int32)  # of obs and next_obs
        self.continues = np.zeros((self.buffer_size, self.n_envs), bool)  # obs is the last next_obs
        self._last_next: dict[str, np.ndarray] | None = None
        self.actions = np.zeros(
            (self.buffer_size, self.n_envs, self.action_dim), self._maybe_cast_dtype(action_space.dtype)
        )
        self.rewards = np.zeros((self.buffer_size, self.n_envs), np.float32)
        self.dones = np.zeros((self.buffer_size, self.n_envs), np.float32)
        self.timeouts = np.zeros((self.buffer_size, self.n_envs), np.float32)

    def add(
        self,
        obs: Observation,
        next_obs: Observation,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one transition of every environment.

        :param obs: Stacked observations (n_envs, ...), one array for each key
        :param next_obs: The next observations; at the end of an episode its last observation, not that of the reset
        :param action: (n_envs, action_dim)
        :param reward: (n_envs,)
        :param done: (n_envs,), 1 where the episode ended
        :param infos: With "TimeLimit.truncated" where the time limit ended the episode
        """
        stacks, next_stacks = self._as_dict(obs), self._as_dict(next_obs)
        successor = (self.pos + 1) % self.buffer_size
        for env in range(self.n_envs):
            old = set(self.slots[self.pos, env].ravel().tolist())
            slots, next_slots = self._store(
                env,
                {key: value[env] for key, value in stacks.items()},
                {key: value[env] for key, value in next_stacks.items()},
            )
            self.slots[self.pos, env] = slots, next_slots
            # Free the slots of the overwritten transition that the next older one does not use: as stacks only move
            # forward, no other one uses them
            self.pool.give_back(old - set(self.slots[successor, env].ravel().tolist()) - {EMPTY})
        self._last_next = {key: value.copy(order="K") for key, value in next_stacks.items()}

        self.actions[self.pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = [info.get("TimeLimit.truncated", False) for info in infos]
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _as_dict(self, observation: Observation) -> dict[str, np.ndarray]:
        observations = observation if isinstance(observation, dict) else {"observation": observation}
        return {key: np.reshape(observations[key], (self.n_envs, *shape)) for key, shape in self.shapes.items()}

    def _store(
        self, env: int, stack: dict[str, np.ndarray], next_stack: dict[str, np.ndarray]
    ) -> tuple[list[int], list[int]]:
        """Store the two stacks of a transition, except frames that are stored already, and return their slots."""
        last = self._last_next
        self.continues[self.pos, env] = last is not None and all(
            np.array_equal(stack[key], last[key][env]) for key in stack
        )
        slots = self.slots[self.pos - 1, env, 1].tolist() if self.continues[self.pos, env] else self._store_stack(stack)
        frames = {key: self._split(key, stack[key]) for key in self.stacked_keys}
        next_frames = {key: self._split(key, next_stack[key]) for key in self.stacked_keys}
        if all(np.array_equal(frames[key][1:], next_frames[key][:-1]) for key in self.stacked_keys):
            return slots, [*slots[1:], self._store_newest(next_stack)]
        return slots, self._store_stack(next_stack)

    def _store_stack(self, stack: dict[str, np.ndarray]) -> list[int]:
        """Store every frame of a stack; padding by zeros or by repetition takes no additional slot."""
        slots = [self._store_newest(stack)]
        frames = {key: self._split(key, stack[key]) for key in self.stacked_keys}
        for j in range(self.n_stack - 2, -1, -1):
            if all(not frames[key][j].any() for key in frames):
                slots.append(EMPTY)
            elif all(np.array_equal(frames[key][j], frames[key][j + 1]) for key in frames):
                slots.append(slots[-1])
            else:
                slots.append(self.pool.take())
                self.pool.write(slots[-1], {key: frames[key][j] for key in frames})
        return slots[::-1]

    def _store_newest(self, stack: dict[str, np.ndarray]) -> int:
        """Store the newest frame of the images and the values of all other keys."""
        slot = self.pool.take()
        frames = {key: self._split(key, stack[key])[-1] if key in self.stacked_keys else stack[key] for key in stack}
        self.pool.write(slot, frames)
        return slot

    def _split(self, key: str, stack: np.ndarray) -> np.ndarray:
        """Split (kC, H, W) into (k, C, H, W)."""
        return stack.reshape(self.n_stack, *self.pool.shapes[key])

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> DictReplayBufferSamples | ReplayBufferSamples:
        env_indices = np.random.randint(0, self.n_envs, size=len(batch_inds))
        if self.n_steps == 1:
            last_inds, discounts = batch_inds, None
            rewards = self._normalize_reward(self.rewards[batch_inds, env_indices], env)
        else:
            last_inds, rewards, discounts = self._n_step_returns(batch_inds, env_indices, env)
        dones = self.dones[last_inds, env_indices] * (1 - self.timeouts[last_inds, env_indices])
        observations, next_observations = self._gather(
            np.stack([self.slots[batch_inds, env_indices, 0], self.slots[last_inds, env_indices, 1]]), env
        )
        samples = DictReplayBufferSamples(
            observations=observations,
            actions=self._to_device(th.from_numpy(self.actions[batch_inds, env_indices])),
            next_observations=next_observations,
            dones=self._to_device(th.from_numpy(dones.reshape(-1, 1))),
            rewards=self._to_device(th.from_numpy(rewards.reshape(-1, 1))),
            discounts=None if discounts is None else self._to_device(th.from_numpy(discounts.reshape(-1, 1))),
        )
        if isinstance(self.observation_space, spaces.Dict):
            return samples
        return ReplayBufferSamples(
            **samples._asdict()
            | {"observations": observations["observation"], "next_observations": next_observations["observation"]}
        )

    def _gather(self, slots: np.ndarray, env: VecNormalize | None) -> tuple[dict[str, th.Tensor], dict[str, th.Tensor]]:
        """Return observations and next observations from their slots (2, batch, k)."""
        self.pool.to(self.device)
        pairs = self._frames(slots)
        obs, next_obs = ({key: pair[i] for key, pair in pairs.items()} for i in range(2))
        if env is not None and env.norm_obs:
            obs, next_obs = obs | self._normalized(obs, env), next_obs | self._normalized(next_obs, env)
        return (
            {key: self._to_device(value) for key, value in obs.items()},
            {key: self._to_device(value) for key, value in next_obs.items()},
        )

    def _frames(self, slots: np.ndarray) -> dict[str, th.Tensor]:
        """Stacks from their slots (m, n, k), as (m, n, ...) for each key."""
        stacks = {}
        for key, shape in self.shapes.items():
            key_slots = slots if key in self.stacked_keys else slots[:, :, -1]  # other keys are in the newest slot
            frames = self.pool.gather(key, key_slots.ravel(), pin_memory=self.device.type == "cuda")
            stacks[key] = frames.view(*slots.shape[:2], *shape)
        return stacks

    def _normalized(self, observations: dict[str, th.Tensor], env: VecNormalize) -> dict[str, th.Tensor]:
        """Return the keys that VecNormalize normalizes, without the others, because it copies whatever it is given."""
        if not isinstance(self.observation_space, spaces.Dict):
            array = self._normalize_obs(observations["observation"].cpu().numpy(), env)
            return {"observation": th.as_tensor(array)}
        assert env.norm_obs_keys is not None
        arrays = self._normalize_obs({key: observations[key].cpu().numpy() for key in env.norm_obs_keys}, env)
        return {key: th.as_tensor(arrays[key]) for key in env.norm_obs_keys}

    def _to_device(self, tensor: th.Tensor) -> th.Tensor:
        if self.device.type == "cuda" and tensor.device.type == "cpu":
            return tensor.pin_memory().to(self.device, non_blocking=True)
        return tensor.to(self.device)

    def _n_step_returns(
        self, batch_inds: np.ndarray, env_indices: np.ndarray, env: VecNormalize | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Compute n-step returns.

        :param batch_inds: Index of each first transition (batch,)
        :param env_indices: Its environment (batch,)
        :param env: The VecNormalize that normalizes rewards
        :return: Index of each last transition, discounted returns and discounts gamma^m, each (batch,)
        """
        indices = (batch_inds[:, None] + np.arange(self.n_steps)) % self.buffer_size  # (batch, n)
        envs = env_indices[:, None]
        ends = (self.dones[indices, envs] + self.timeouts[indices, envs]) > 0
        ends |= indices == (self.pos - 1) % self.buffer_size  # the last one written
        ends |= ~self.continues[(indices + 1) % self.buffer_size, envs]
        n_rewards = np.where(ends.any(axis=1), ends.argmax(axis=1) + 1, self.n_steps)
        discounts = self.gamma ** np.arange(self.n_steps, dtype=np.float32)
        rewards = self._normalize_reward(self.rewards[indices, envs], env)
        returns = (rewards * discounts * (np.arange(self.n_steps) < n_rewards[:, None])).sum(axis=1)
        last_inds = (batch_inds + n_rewards - 1) % self.buffer_size
        return last_inds, returns, self.gamma ** n_rewards.astype(np.float32)

    @property
    def observations(self) -> Observation:  # type: ignore[override]
        """All observations as in SB3's buffers, (buffer_size, n_envs, ...) for each key; they are copied out."""
        return self._all_observations(0)

    @property
    def next_observations(self) -> Observation:  # type: ignore[override]
        """All next observations, like :attr:`observations`."""
        return self._all_observations(1)

    def _all_observations(self, which: int) -> Observation:
        size = self.buffer_size, self.n_envs
        if self.pool.n_used == 0:
            arrays = {key: np.zeros((*size, *shape), self.pool.dtypes[key]) for key, shape in self.shapes.items()}
        else:
            slots = self.slots[:, :, which].reshape(1, -1, self.n_stack)
            arrays = {
                key: frames.cpu().numpy().reshape(*size, *self.shapes[key])
                for key, frames in self._frames(slots).items()
            }
        return arrays if isinstance(self.observation_space, spaces.Dict) else arrays["observation"]

    def truncate_last_trajectory(self) -> None:
        """Make n-step returns stop at the last stored transition, as needed after loading the buffer."""
        self._last_next = None

    def reset(self) -> None:
        super().reset()
        self.pool.give_back(set(self.slots.ravel().tolist()) - {EMPTY})
        self.slots[:] = EMPTY
        self._last_next = None

    @property
    def nbytes(self) -> int:
        """Bytes in use: the largest number of frames that were stored at once, and the tables."""
        tables = (self.slots, self.continues, self.actions, self.rewards, self.dones, self.timeouts)
        return self.pool.nbytes + sum(table.nbytes for table in tables)


def stacked_frames(env: VecEnv) -> int:
    """Return the number of frames that ``VecFrameStack`` stacks somewhere in a chain of wrappers, or 1 without it."""
    wrapper = unwrap_vec_wrapper(env, VecFrameStack)
    return 1 if wrapper is None else wrapper.stacked_obs.n_stack
