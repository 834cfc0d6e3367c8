"""Test of a localised pose by the points of the map that a picture taken there should show: at a
look-alike it shows few of them, and none in some directions. See
`gsba.loop_closure.join_evidence`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import CubeRig
from gsba.features.detection import traits_of
from gsba.frames import cubemap
from gsba.geometry import inverse
from gsba.localization.place_index import index_path, load_or_make
from gsba.localization.run_map import Query, RunMap
from gsba.log import GsbaError
from gsba.loop_closure.join_evidence import (
    GATE_RAD,
    NUM_SIGMAS_LIKELY,
    FindingRates,
    JoinEvidence,
    Places,
    Predictions,
    evidence_of,
    predicted,
    rates_of,
    turned_away,
)
from gsba.matching.guided_search import Gate, match_pair
from gsba.types import Features, FrameSet, rows_across

_NUM_NEAREST = 6  # keyframes whose points are expected in a picture
# Share in regions that show next to nothing of what is expected there: at least .41 where places
# look alike, at most .30 at true poses beyond the ends of a map.
_LOOK_ALIKE_STRANGE = 0.35

Shown = Callable[[np.ndarray], np.ndarray]  # True (N,) for points (N, 3) of the picture's frame
# that lie within it


@dataclass(frozen=True, slots=True)
class PictureRates:
    """Rates at which pictures show what a map expects, by camera; those of photos come last, as
    faces of the first camera's frames show it."""

    within: np.ndarray  # (C + 1, B) float64, see `Rates`
    chance: np.ndarray  # (C + 1,) float64
    placed: np.ndarray  # (C + 1, B) float64
    face_px: np.ndarray  # (C,) int64, across the faces on which keypoints are to be found

    def of_camera(self, camera: int) -> FindingRates:
        """Rates of a camera's panoramas."""
        return FindingRates(self.within[camera], float(self.chance[camera]), self.placed[camera])


class Surroundings:
    """Points that a picture taken from some pose is expected to show."""

    def __init__(self, map_: RunMap) -> None:
        self.map = map_
        num = len(map_.result.points_world)
        self._num_observers = np.bincount(map_.result.observation_points, None, num)

    def rates(self, frames: Sequence[int], seen: Sequence[Query]) -> FindingRates:
        """Rates at which frames (N,) of the map show what the map without them would expect, by
        their keypoints (N), found as those of the pictures to test."""
        poses = self.map.result.world_T_rigs
        at, away = [], []
        for frame, picture in zip(frames, seen, strict=True):
            at.append(self._predictions(picture, poses[frame], frame))
            away.append(self._predictions(picture, turned_away(poses[frame]), frame))
        return rates_of(Predictions.joined(at), Predictions.joined(away))

    def evidence(
        self, seen: Query, world_T_rig: np.ndarray, usual: FindingRates, shown: Shown | None = None
    ) -> JoinEvidence:
        """Evidence for and against a pose (4, 4); `shown` tells the points within a picture with
        edges."""
        found = self._predictions(seen, world_T_rig, shown=shown)
        if not len(found.bins):
            return JoinEvidence(0.0, np.inf, 0)
        depth = float(np.median(np.linalg.norm(found.points_world - world_T_rig[:3, 3], axis=1)))
        return evidence_of(found, usual, depth)

    def _predictions(
        self,
        seen: Query,
        world_T_rig: np.ndarray,
        left_out: int | None = None,
        shown: Shown | None = None,
    ) -> Predictions:
        """Points of the nearest keyframes predicted in a picture, as if one frame were left out."""
        map_ = self.map
        result, num_observers = map_.result, self._num_observers
        nearest = map_.nearest(world_T_rig, _NUM_NEAREST + 1)
        nearest = nearest[nearest != left_out][:_NUM_NEAREST]
        if left_out is not None:
            num_observers = num_observers.copy()
            num_observers[result.observation_points[result.observation_frames == left_out]] -= 1
        of_map = num_observers >= 2  # others are no points of a map that lacks one of its frames
        keyframes = [map_.load_keyframe(int(f)) for f in nearest]
        points = np.unique(np.concatenate([keyframe.points for keyframe in keyframes]))
        points = result.points_world[points[of_map[points]]]
        around = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
        gate, chosen, found = Gate.around_points(GATE_RAD), traits_of(map_.settings), []
        for f, keyframe in zip(nearest, keyframes, strict=True):
            f_T_rig = inverse(result.world_T_rigs[f]) @ world_T_rig
            own = keyframe.points_rig
            expected = of_map[keyframe.points]
            if shown is not None:
                expected &= shown((own - f_T_rig[:3, 3]) @ f_T_rig[:3, :3])
            matched = match_pair(keyframe.all, seen.all, f_T_rig, gate, chosen, own)
            poses = np.array([result.world_T_rigs[f], world_T_rig])
            places = Places(poses, [np.where(expected[:, None], own, np.nan), around])
            found.append(predicted(places, 0, 1, matched, seen.bearings, surfaces=True))
        return Predictions.joined(found)


def open_rates(
    surroundings: Surroundings,
    rigs: Sequence[CubeRig],
    extract: Callable[[FrameSet, int, CubeRig], Features],
    query_of: Callable[[Features, int, CubeRig], Query],
) -> PictureRates:
    """Rates of a map: those kept beside the run if they are the run's, else measured on faces of
    `rigs` (C) and kept; where pictures of the run are gone, by its stored keypoints."""
    map_ = surroundings.map

    def rates_of_camera(camera: int) -> tuple[FindingRates, FindingRates, int]:
        """Rates of a camera's panoramas, of photos by its frames, and pixels across faces."""
        rows, rig = np.flatnonzero(map_.frames.cameras == camera), rigs[camera]
        frames = rows[rows_across(len(rows), 16)].tolist()
        own = cubemap.rig_for(map_.frames.formats[camera], map_.settings.cubemap)
        stored = [query_of(map_.load_features(f), camera, own) for f in frames]
        as_stored = surroundings.rates(frames, stored)
        if rig == own:
            return as_stored, as_stored, own.size
        try:
            found = [query_of(extract(map_.frames, f, rig), camera, rig) for f in frames]
        except GsbaError:
            return as_stored, as_stored, own.size
        return surroundings.rates(frames, found), as_stored, rig.size

    def measure() -> PictureRates:
        panoramas, photos, face_px = zip(*map(rates_of_camera, range(len(rigs))), strict=True)
        rows = *panoramas, photos[0]
        return PictureRates(
            np.array([row.within for row in rows]),
            np.array([row.chance for row in rows]),
            np.array([row.placed for row in rows]),
            np.array(face_px, np.int64),
        )

    path = index_path(map_.root).with_name("rates.npz")
    return load_or_make(map_, path, PictureRates, measure)


def is_look_alike(evidence: JoinEvidence) -> bool:
    """True unless a panorama shows significantly more than where places look alike, and hardly a
    direction is strange."""
    margin = evidence.margin(NUM_SIGMAS_LIKELY)
    return not (margin > 0 and evidence.strange < _LOOK_ALIKE_STRANGE)


def is_contradicted(evidence: JoinEvidence) -> bool:
    """True if a photo shows significantly less than it would at its pose, or a part of it is
    strange. One that shows nothing but what repeats elsewhere cannot be told from a look-alike."""
    return evidence.refuted or evidence.strange >= _LOOK_ALIKE_STRANGE
