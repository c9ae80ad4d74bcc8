"""sb3-contrib's TQC with the encoders of HAVESAC."""

from typing import Any

from sb3_contrib.tqc.policies import MultiInputPolicy

from sb3_have.common.encoders import MultiModalExtractor


class MultiModalTQCPolicy(MultiInputPolicy):
    """TQC's policy with :class:`~sb3_have.common.encoders.MultiModalExtractor` as the default features extractor."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs = {"features_extractor_class": MultiModalExtractor, "normalize_images": False, **kwargs}
        super().__init__(*args, **kwargs)
