"""sb3-contrib's TQC with the encoders of HAVESAC."""

from typing import Any

from sb3_contrib.tqc.policies import MultiInputPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_have.common.encoders import MultiModalExtractor


class MultiModalTQCPolicy(MultiInputPolicy):
    """
    TQC's policy with :class:`~sb3_have.common.encoders.MultiModalExtractor` as the default features extractor.

    :param features_extractor_class: Features extractor to use
    :param normalize_images: Whether SB3 divides images by 255; the encoders decode the bytes themselves
    """

    def __init__(
        self,
        *args: Any,
        features_extractor_class: type[BaseFeaturesExtractor] = MultiModalExtractor,
        normalize_images: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            *args, features_extractor_class=features_extractor_class, normalize_images=normalize_images, **kwargs
        )
