"""Callback that logs the weights of the modalities."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Image, TensorBoardOutputFormat

from sb3_have.checkpoint.files import write_atomically
from sb3_have.checkpoint.random_state import same_random_numbers
from sb3_have.common.log_names import log_names
from sb3_have.evaluation.recording import record_episode, weighing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Outputs of SB3's logger that do not support histograms and images
NOT_TEXT = ("stdout", "log", "json", "csv")


class ModalityWeightsCallback(BaseCallback):
    """
    Callback for logging the weights of the modalities.

    It logs the mean of the latest weights as ``have/weight_<modality>`` and, in TensorBoard, their histograms as
    ``have/weights_<modality>``. At intervals it also logs an episode as ``have/episode``: the frames of each modality
    above their weights (as in Fig. 5 of the paper).

    The weights are computed every ``read_freq`` steps from the observations that the agent acts on, in all
    environments, which costs one pass through the encoders. The episode is always the same one, driven in a separate
    environment. The callback does not change the training: with and without it, the parameters are equal bit for bit.

    With ``value_estimation="gve"``, which has no weights, the callback warns and does nothing.

    :param read_freq: Compute the weights every ``read_freq`` steps of each environment
    :param window: Number of readings in means and histograms, similar to SB3's ``stats_window_size``
    :param eval_env: The environment for the episode: its id, or a (not vectorized) environment other than the training
        environment. Frame stack and normalization are those of the training.
    :param episode_freq: Drive the episode every ``episode_freq`` steps, counted over all environments; 0 for never
    :param weather: Weather of the episode, for environment ids that have this keyword
    :param env_kwargs: Additional keyword arguments for ``gym.make``, the same as in training
    :param seed: Seed of the episode
    :param max_steps: Maximum number of steps of the episode
    :param folder: Folder in which to save each episode as ``weights-<step>.png``
    :param verbose: Verbosity level
    :raises ValueError: if a number is out of range, or if ``eval_env`` is missing
    """

    def __init__(
        self,
        read_freq: int = 10,
        window: int = 100,
        eval_env: str | gym.Env[Any, Any] | None = None,
        episode_freq: int = 0,
        weather: str | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
        seed: int = 0,
        max_steps: int | None = 500,
        folder: str | Path | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        for name, value, least in (
            ("read_freq", read_freq, 1),
            ("window", window, 1),
            ("episode_freq", episode_freq, 0),
        ):
            if not (isinstance(value, int | np.integer) and value >= least):
                raise ValueError(f"{name}={value!r}: expected a whole number >= {least}.")
        if episode_freq and eval_env is None:
            raise ValueError(
                f"episode_freq={episode_freq} needs an eval_env other than the training environment: an id such as "
                'eval_env="HighwayVision-v0", or an environment.'
            )
        self.read_freq, self.window = read_freq, window
        self.eval_env, self.episode_freq = eval_env, episode_freq
        self.folder = None if folder is None else Path(folder)
        self._record = partial(
            record_episode,
            weather=weather,
            seed=seed,
            env_kwargs=env_kwargs,
            max_steps=max_steps,
        )
        self._weigh: Callable[[Any], Mapping[str, np.ndarray]] | None = None
        self._readings: dict[str, deque[np.ndarray]] = {}
        self._names: dict[str, str] = {}

    def _init_callback(self) -> None:
        if not hasattr(self.model, "modality_weights"):
            raise TypeError(
                f"ModalityWeightsCallback: {type(self.model).__name__} has no modality_weights(); train a HAVESAC."
            )
        self._weigh = weighing(self.model)
        if self._weigh is None:
            warnings.warn(
                'ModalityWeightsCallback does nothing with value_estimation="gve": it has no weights.',
                UserWarning,
                stacklevel=2,
            )
            return
        trained = [env.unwrapped for env in getattr(self.training_env.unwrapped, "envs", [])]
        if isinstance(self.eval_env, gym.Env) and any(env is self.eval_env.unwrapped for env in trained):
            raise ValueError("eval_env is the training environment; pass another one, because the episode resets it.")

    def _on_training_start(self) -> None:
        outputs = self.logger.output_formats
        self._tensorboard = any(isinstance(output, TensorBoardOutputFormat) for output in outputs)
        if self.episode_freq and self._weigh is not None and not self._tensorboard and self.folder is None:
            warnings.warn(
                "ModalityWeightsCallback logs no episodes, because there is neither TensorBoard "
                "(HAVESAC(..., tensorboard_log=...)) nor a folder=... for them.",
                UserWarning,
                stacklevel=2,
            )
            return
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        if self.eval_env is not None and self.episode_freq and self._weigh is not None:
            # Fail now if the environment does not fit, and not after ``episode_freq`` steps
            with same_random_numbers():
                self._record(self.model, self.eval_env, max_steps=1)

    def _on_step(self) -> bool:
        if self._weigh is None:
            return True
        if (self.n_calls - 1) % self.read_freq == 0:
            # `_last_obs` is still the observation for which the action of this step was chosen
            for name, weights in self._weigh(self.model._last_obs).items():
                self._readings.setdefault(name, deque(maxlen=self.window)).append(weights)
        # Record at every step, because the logger may be dumped at any time
        if self._names.keys() != self._readings.keys():
            self._names = log_names(self._readings, 26)
        for name, readings in self._readings.items():
            latest = np.concatenate(readings)
            self.logger.record(f"have/weight_{self._names[name]}", float(latest.mean()))
            if self._tensorboard:
                self.logger.record(f"have/weights_{name}", latest, exclude=NOT_TEXT)
        if self._episode_is_due():
            self._log_episode()
        return True

    def get_state(self) -> dict[str, deque[np.ndarray]]:
        """Return the latest weights for a checkpoint."""
        return self._readings

    def set_state(self, state: dict[str, deque[np.ndarray]]) -> None:
        """Restore the latest weights from a checkpoint."""
        self._readings = state

    def _episode_is_due(self) -> bool:
        if not self.episode_freq or not (self._tensorboard or self.folder):
            return False
        step, n_envs = self.num_timesteps, self.training_env.num_envs
        return step // self.episode_freq > (step - n_envs) // self.episode_freq

    def _log_episode(self) -> None:
        from sb3_have.plotting.episode import plot_modality_weights  # importing matplotlib takes a second

        assert self.eval_env is not None
        with same_random_numbers():
            recording = self._record(self.model, self.eval_env)
        figure = plot_modality_weights(recording)
        if self.folder is not None:
            path = self.folder / f"weights-{self.num_timesteps}.png"
            write_atomically(path, partial(figure.savefig, dpi=100, format="png"))
        if self._tensorboard:
            self.logger.record("have/episode", Image(_pixels(figure), "HWC"), exclude=NOT_TEXT)
        if self.verbose >= 1:
            print(f"Step {self.num_timesteps}: episode of {len(recording.infos)} steps logged")


def _pixels(figure: Figure) -> np.ndarray:
    """Draw a figure to uint8 (H, W, 3). SB3's ``Figure`` would need pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
