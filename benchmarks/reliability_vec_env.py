"""ReliabilityDrive-v0 as a vectorized SB3 environment on one batch of arrays instead of N environments."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_have.envs.reliability_drive import DriveBatch


class ReliabilityDriveVecEnv(VecEnv):
    """
    Vectorized environment that is bit for bit equal to a ``DummyVecEnv`` of :class:`ReliabilityDriveEnv`, but several
    times faster.

    :param num_envs: Number of environments
    :param options: Options of :class:`DriveBatch`
    """

    def __init__(self, num_envs: int, **options: Any):
        self.batch = DriveBatch(num_envs, **options)
        super().__init__(num_envs, self.batch.observation_space, self.batch.action_space)

    def reset(self) -> VecEnvObs:
        for i, seed in enumerate(self._seeds):
            if seed is not None:
                self.batch.rngs[i] = seeding.np_random(seed)[0]
        self._reset_seeds()
        self._reset_options()
        self.batch.reset(np.arange(self.num_envs))
        self.reset_infos = [self.batch.info(i) for i in range(self.num_envs)]
        return self.batch.observation()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        rewards, terminated, truncated = self.batch.step(self._actions)
        observation, dones = self.batch.observation(), terminated | truncated
        infos = [self.batch.info(i) for i in range(self.num_envs)]
        for i, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncated[i])
        ended = np.flatnonzero(dones).tolist()
        if ended:
            for i in ended:
                infos[i]["terminal_observation"] = {key: value[i].copy() for key, value in observation.items()}
            self.batch.reset(np.array(ended))
            observation = self.batch.observation()
            for i in ended:
                self.reset_infos[i] = self.batch.info(i)
        return observation, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise NotImplementedError(f"cannot set {attr_name!r}; pass the options to the constructor")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        raise NotImplementedError(f"cannot call {method_name!r}, because the environments are one batch")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [None] * self.num_envs
