"""The observed frames of a run: their keypoints, as rays of the lenses that are known so far."""

from dataclasses import dataclass, field, replace

from gsba.camera.lens import Lenses
from gsba.matching.guided_search import MatchContext
from gsba.store.store import PerFrame
from gsba.types import Features, Keypoints


@dataclass(frozen=True, slots=True)
class ObservedFrames:
    """Keypoints of all frames, and the means to match them."""

    features: tuple[PerFrame[Features], ...]  # (F,) stage that holds each frame's
    shown: Keypoints  # of all frames, where pictures show them
    context: MatchContext  # matches them
    lenses: Lenses = field(default_factory=Lenses)  # that the keypoints are seen through

    @property
    def keypoints(self) -> Keypoints:
        """Of all frames, as rays of the lenses."""
        return self.context.keypoints

    def through(self, lenses: Lenses) -> "ObservedFrames":
        """The frames with their keypoints as rays that start at these lenses."""
        context = replace(self.context, keypoints=lenses.seen(self.shown), lenses=lenses)
        return replace(self, context=context, lenses=lenses)
