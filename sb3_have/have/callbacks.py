"""What the agent looks at while it learns, in SB3's logger."""

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
from sb3_have.evaluation.recording import record_episode, weighing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NOT_TEXT = ("stdout", "log", "json", "csv")
"""Outputs of SB3's logger that take no histograms and images."""


class ModalityWeightsCallback(BaseCallback):
    """
    Logs how much each modality counts: ``have/weight_<modality>``, the mean of the latest weights, and in TensorBoard
    their histograms ``have/weights_<modality>``; at intervals an episode, ``have/episode``: the frames of each modality
    over the weights (as the paper's Fig. 5).

    The weights are those of the observations that the agent acts on, of all environments, read every ``read_freq``
    steps: one pass through the encoders each, and unlike a sample of the replay buffer they say what counts now. The
    episode is driven in an environment of its own, the same episode every time. Neither changes the run: training with
    and without the callback gives the same weights, bit for bit.

    With ``value_estimation="gve"``, which has no weights, the callback warns and does nothing.

    :param read_freq: steps of each environment from one reading to the next
    :param window: readings that mean and histograms are of, like SB3's ``stats_window_size``
    :param eval_env: id of the environment for the episode, made each time, or a (not vectorized) environment; not
        the one that is trained in. Frame stack and normalisation follow from the training.
    :param episode_freq: steps from one episode to the next, counted over all environments; 0 for none
    :param weather: of the episode, for ids of environments that have the keyword
    :param env_kwargs: further keywords for ``gym.make``, the same as in training
    :param seed: of the episode
    :param max_steps: of the episode that are recorded at most
    :param folder: where each episode is also kept as ``weights-<step>.png``, for those without TensorBoard
    :param verbose: as in SB3
    :raises ValueError: if numbers are out of range, or there is no ``eval_env`` for the episodes
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
            if not (isinstance(value, int) and value >= least):
                raise ValueError(f"{name}={value!r}: expected a whole number, {least} or more.")
        if episode_freq and eval_env is None:
            raise ValueError(
                f"episode_freq={episode_freq} needs eval_env, an environment other than the one that is trained in: "
                'its id, such as eval_env="HighwayVision-v0", or one that was made.'
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

    def _init_callback(self) -> None:
        if not hasattr(self.model, "modality_weights"):
            raise TypeError(
                f"ModalityWeightsCallback: {type(self.model).__name__} has no modality_weights(); train a HAVESAC."
            )
        self._weigh = weighing(self.model)
        if self._weigh is None:
            warnings.warn(
                'ModalityWeightsCallback does nothing with value_estimation="gve": it has no weights of modalities.',
                UserWarning,
                stacklevel=2,
            )
            return
        trained = [env.unwrapped for env in getattr(self.training_env.unwrapped, "envs", [])]
        if isinstance(self.eval_env, gym.Env) and any(env is self.eval_env.unwrapped for env in trained):
            raise ValueError("eval_env is the environment that is trained in: give another one, an episode resets it.")

    def _on_training_start(self) -> None:
        outputs = self.logger.output_formats
        self._tensorboard = any(isinstance(output, TensorBoardOutputFormat) for output in outputs)
        if self.episode_freq and self._weigh is not None and not self._tensorboard and self.folder is None:
            warnings.warn(
                "ModalityWeightsCallback: no episodes are drawn, as there is no TensorBoard "
                "(HAVESAC(..., tensorboard_log=...)) to show them, and no folder=... to keep them.",
                UserWarning,
                stacklevel=2,
            )
            return
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
        if self.eval_env is not None and self.episode_freq and self._weigh is not None:
            with same_random_numbers():  # what does not fit is refused now, not after the first ``episode_freq`` steps
                self._record(self.model, self.eval_env, max_steps=1)

    def _on_step(self) -> bool:
        if self._weigh is None:
            return True
        if (self.n_calls - 1) % self.read_freq == 0:
            # still the observation that the action of this step was chosen for
            for name, weights in self._weigh(self.model._last_obs).items():
                self._readings.setdefault(name, deque(maxlen=self.window)).append(weights)
        # at every step, as nothing tells when the logger is dumped: after the episode's end, or by another callback
        for name, readings in self._readings.items():
            latest = np.concatenate(readings)
            self.logger.record(f"have/weight_{name}", float(latest.mean()))
            if self._tensorboard:
                self.logger.record(f"have/weights_{name}", latest, exclude=NOT_TEXT)
        if self._episode_is_due():
            self._log_episode()
        return True

    def _episode_is_due(self) -> bool:
        if not self.episode_freq or not (self._tensorboard or self.folder):
            return False
        step, n_envs = self.num_timesteps, self.training_env.num_envs
        return step // self.episode_freq > (step - n_envs) // self.episode_freq

    def _log_episode(self) -> None:
        from sb3_have.plotting.episode import plot_modality_weights  # matplotlib takes a second to import

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
            print(f"Step {self.num_timesteps}: episode of {len(recording.infos)} steps drawn")


def _pixels(figure: Figure) -> np.ndarray:
    """uint8 (H, W, 3); not SB3's ``Figure``, which draws by pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
