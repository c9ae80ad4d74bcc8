"""Replay buffer setup and input validation for HAVESAC."""

import io
import pathlib
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_have.common.buffers import ModalityReplayBuffer, stacked_frames
from sb3_have.have.policies import check_observation, check_stored_observation


class SensorSAC(SAC):
    """
    SAC that creates a :class:`~sb3_have.ModalityReplayBuffer` by default for images and for n-step returns, with the
    environment's frame stack, ``n_steps`` and ``gamma``, and that refuses observations and rewards that are not finite.
    The parameters are SAC's.
    """

    n_stack = 1

    def _setup_model(self) -> None:
        if self.env is not None:  # else the model is being loaded, and this with it
            self.n_stack = stacked_frames(self.env)
        if self.replay_buffer_class is None and (self.n_steps > 1 or has_images(self.observation_space)):
            self.replay_buffer_class = ModalityReplayBuffer
        given = self.n_steps, self.replay_buffer_kwargs
        if self.replay_buffer_class is not None and issubclass(self.replay_buffer_class, ModalityReplayBuffer):
            self.replay_buffer_kwargs = self._replay_buffer_kwargs()
            self.n_steps = 1  # SB3 would warn that it is ignored
        super()._setup_model()
        self.n_steps, self.replay_buffer_kwargs = given

    def _replay_buffer_kwargs(self) -> dict[str, Any]:
        """Of a ModalityReplayBuffer: what the user gave, and what follows from environment and algorithm."""
        return {"n_stack": self.n_stack, "n_steps": self.n_steps, "gamma": self.gamma, **self.replay_buffer_kwargs}

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        :param path: of the pickled replay buffer
        :param truncate_last_traj: whether the last trajectory ends where the buffer was saved; False if the environment
            goes on from there
        """
        super().load_replay_buffer(path, truncate_last_traj)
        if isinstance(self.replay_buffer, ModalityReplayBuffer):
            kwargs = self._replay_buffer_kwargs()
            self.replay_buffer.n_steps, self.replay_buffer.gamma = kwargs["n_steps"], kwargs["gamma"]
            if truncate_last_traj:
                self.replay_buffer.truncate_last_trajectory()

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        assert self._last_obs is not None
        check_observation(self._last_obs, self.observation_space)
        if self._vec_normalize_env is not None:
            assert self._last_original_obs is not None
            check_stored_observation(self._last_original_obs, self.observation_space)
        return result

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Refuses NaN before it reaches the replay buffer, where it would spoil the networks unseen."""
        last_observations = [info.get("terminal_observation") for info in infos]  # new_obs has the next episode's first
        for observation in [new_obs, *(last for last in last_observations if last is not None)]:
            check_observation(observation, self.observation_space)
        if not np.isfinite(reward).all():
            raise ValueError(
                f"reward: got {reward} at step {self.num_timesteps}, expected finite numbers; mend the environment's "
                "reward function (SB3's VecCheckNan shows where it comes from)."
            )
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)


def has_images(space: spaces.Space[Any]) -> bool:
    """Whether an observation space, or one of its keys, is a uint8 image."""
    return any(map(is_image_space, space.spaces.values() if isinstance(space, spaces.Dict) else [space]))
