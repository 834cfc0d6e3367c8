"""Search for a picture's pose among candidate points: its significance, and rivals.

The true pose shows what is expected around, and explains keypoints that the others leave."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import cells_of
from gsba.localization.surroundings import is_look_alike
from gsba.loop_closure.join_evidence import JoinEvidence
from gsba.matching.absolute_pose import (
    MIN_WITNESSES,
    FoundPose,
    are_apart,
    is_significant,
    panorama_pose,
)
from gsba.significance import SIGMAS_OF_1E_3
from gsba.trajectory.turning import CELLS_PER_SIDE
from gsba.types.records import with_rows

MIN_RATIO = 0.02  # least inlier ratio that the number of trials allows for
_MIN_SHARE = 0.25  # of the first pose's inliers, that further poses must have
TWO_PLACES = "two places of the map look like it"
LOOK_ALIKE = "the place that it looks like shows other things around"


@dataclass(frozen=True, slots=True)
class Candidates:
    """Keypoints of a picture, and the points of the map that each may show."""

    keypoints: np.ndarray  # (m,) int64, numbers of keypoints; one may have several points
    bearings: np.ndarray  # (m, 3) unit, rig frame
    points: np.ndarray  # (m,) int64, numbers of points
    points_world: np.ndarray  # (m, 3) map units

    def __len__(self) -> int:
        return len(self.points)


def search_poses(
    candidates: Candidates, max_error_rad: float, seed: int, most: int
) -> list[FoundPose]:
    """Significant poses of a panorama, each of the candidates that those before leave over."""
    found, least = list[FoundPose](), MIN_WITNESSES
    chance = (1 - np.cos(max_error_rad)) / 2  # a disc's share of the sphere
    while len(found) < most:
        given = candidates.bearings, candidates.points_world
        one = panorama_pose(*given, max_error_rad, seed, least, MIN_RATIO)
        if one is None or not is_significant(candidates.bearings, one.inliers, chance):
            break
        least = max(least, int(_MIN_SHARE * one.inliers.sum()))
        found.append(one)
        candidates = with_rows(candidates, ~one.inliers)
    return found


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
