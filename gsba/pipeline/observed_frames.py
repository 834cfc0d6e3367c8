"""The observed frames of a run: their keypoints, as rays of the cameras that are known so far."""

from dataclasses import dataclass, replace

from gsba.camera.cameras import Cameras
from gsba.matching.guided_search import MatchContext
from gsba.store.store import PerFrame
from gsba.types import Features, Keypoints


@dataclass(frozen=True, slots=True)
class ObservedFrames:
    """Keypoints of all frames, and the means to match them."""

    features: tuple[PerFrame[Features], ...]  # (F,) stage that holds each frame's
    shown: Keypoints  # of all frames, where pictures show them
    context: MatchContext  # matches them
    cameras: Cameras  # that the keypoints are seen through
    more: bool = False  # whether all frames got as many keypoints as weak ones from the start

    @property
    def keypoints(self) -> Keypoints:
        """Of all frames, as rays of the cameras."""
        return self.context.keypoints

    def through(self, cameras: Cameras) -> "ObservedFrames":
        """The frames with their keypoints as rays that start at the lenses of these cameras."""
        context = replace(self.context, keypoints=cameras.seen(self.shown), cameras=cameras)
        return replace(self, context=context, cameras=cameras)
