"""The choice among poses of a picture at several places that look like it: the true one shows what
is expected around, and explains keypoints that the others leave."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import cells_of
from gsba.localization.pose_search import are_apart
from gsba.localization.surroundings import is_look_alike
from gsba.loop_closure.join_evidence import JoinEvidence
from gsba.significance import SIGMAS_OF_1E_3
from gsba.trajectory.turning import CELLS_PER_SIDE

TWO_PLACES = "two places of the map look like it"
LOOK_ALIKE = "the place that it looks like shows other things around"


@dataclass(frozen=True, slots=True)
class PlacedPose:
    """A pose fitted to the points around it."""

    world_T_rig: np.ndarray  # (4, 4)
    depth: float  # median distance of the points that agree, map units
    cells: np.ndarray  # (N,) int64, ascending, cells of the sphere with keypoints that agree
    evidence: JoinEvidence  # of its surroundings

    @classmethod
    def of(
        cls,
        world_T_rig: np.ndarray,
        points_world: np.ndarray,
        bearings: np.ndarray,
        evidence: JoinEvidence,
    ) -> "PlacedPose":
        """A pose, the points (N, 3) that agree with it, and their keypoints' bearings (N, 3)."""
        depth = float(np.median(np.linalg.norm(points_world - world_T_rig[:3, 3], axis=1)))
        return cls(world_T_rig, depth, np.unique(cells_of(bearings, CELLS_PER_SIDE)), evidence)


def best_of(poses: Sequence[PlacedPose]) -> tuple[int, str]:
    """The pose that most cells agree with, and why it is not accepted; "" = its surroundings
    confirm it, and it explains significantly more than every other place that is no look-alike."""
    best = max(range(len(poses)), key=lambda n: len(poses[n].cells))
    one = poses[best]
    if not one.evidence.confirmed:
        return best, LOOK_ALIKE
    for other in poses:
        apart = are_apart(one.world_T_rig, other.world_T_rig, one.depth)
        common = len(np.intersect1d(one.cells, other.cells, assume_unique=True))
        own, others = len(one.cells) - common, len(other.cells) - common
        more = own - others > SIGMAS_OF_1E_3 * np.sqrt(own + others)  # a sign test
        if apart and not is_look_alike(other.evidence) and not more:
            return best, TWO_PLACES
    return best, ""
