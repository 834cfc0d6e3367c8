"""Places of a walk: selected keyframes, with descriptors and points for place recognition."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsba.bundle.tracks import build
from gsba.bundle.triangulation import place
from gsba.camera.rig import CubeRig
from gsba.config import FeatureSettings, RefineSettings
from gsba.features.detection import SiftExtractor, extract, gather
from gsba.log import track
from gsba.matching.correspondences import match_along_epipolars
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.odometry.atlas import AtlasLayout, Cutter
from gsba.store.shards import Workers
from gsba.types import Features, Solution

_HFOV = np.deg2rad(94.0)  # of faces: keypoints near a border are described by pixels beyond it


@dataclass(frozen=True, slots=True)
class KeyframePlaces:
    """Selected keyframes of maps with points; each place is a frame of the matching."""

    keyframes: np.ndarray  # (P,) int64, numbers of the keyframes
    maps: np.ndarray  # (P,) int32, map in which each was tracked
    features: Sequence[Features]  # (P), keypoints and their descriptors
    solved: Solution  # poses, each in the world of its map, and points of the keypoints
    context: MatchContext  # for matching the keypoints

    def taken(self, rows: np.ndarray, world_T_rigs: np.ndarray) -> "KeyframePlaces":
        """Some places (P',), ascending, with other poses (P', 4, 4), triangulated again."""
        features = [self.features[row] for row in rows]
        seed, workers = self.context.settings.seed, self.context.workers
        return make_places(
            self.keyframes[rows], self.maps[rows], world_T_rigs, features, seed, workers
        )


def chosen_keyframes(
    world_T_rigs: np.ndarray, maps: np.ndarray, distances: np.ndarray
) -> np.ndarray:
    """Numbers (P,) of keyframes at least a step from the one selected before, of poses (K, 4, 4),
    maps (K,), -1 = a map without points, and median distances (K,) of points, map units."""
    chosen: list[int] = []
    for k in np.flatnonzero(maps >= 0).tolist():
        if chosen and maps[chosen[-1]] == maps[k]:
            moved = world_T_rigs[k, :3, 3] - world_T_rigs[chosen[-1], :3, 3]
            if np.linalg.norm(moved) < 0.12 * distances[k]:
                continue
        chosen.append(k)
    return np.array(chosen, np.int64)


def described(
    pictures: Sequence[np.ndarray], width: int, usable: np.ndarray | None
) -> list[Features]:
    """Keypoints of keyframes' panoramas, JPEG (n,) uint8, `width` pixels across; usable: (h, 2h)
    bool, pixels of the scene, None = all."""
    size = round(width / np.pi * np.tan(_HFOV / 2))
    rig = CubeRig(size, _HFOV)
    layout = AtlasLayout(rig)
    cutter, extractor = Cutter(layout), SiftExtractor(FeatureSettings(max_per_face=150))

    def faces(grey: np.ndarray) -> np.ndarray:
        atlas = cutter.cut(grey, np.eye(3)).image.reshape(2, size, 3, size)
        return atlas.swapaxes(1, 2).reshape(6, size, size)

    masks = None if usable is None else faces(usable.astype(np.uint8) * 255) > 250

    def describe(picture: np.ndarray) -> Features:
        grey = faces(np.asarray(cv2.imdecode(picture, cv2.IMREAD_GRAYSCALE)))
        return extract(np.repeat(grey[..., None], 3, axis=-1), masks, rig, extractor)

    return [describe(picture) for picture in track(pictures, "describing places", len(pictures))]


def make_places(
    keyframes: np.ndarray,
    maps: np.ndarray,
    world_T_rigs: np.ndarray,
    features: Sequence[Features],
    seed: int,
    workers: Workers,
) -> KeyframePlaces:
    """Match each place with its neighbours, along poses (P, 4, 4), each in the world of its map,
    and triangulate common points; keyframes and maps (P,) are their numbers, for features see
    `described`."""
    context = MatchContext(
        SearchableFrames(features.__getitem__),
        SearchableFrames(features.__getitem__, 100),  # strongest ones of a face, compared without
        # any prediction
        gather(features),
        RefineSettings(seed=seed),
        workers,
        far_drift=0.03,  # largest relative drift that a loop closure may correct
    )
    start = Solution.without_points(world_T_rigs)
    found = match_along_epipolars(context, start)
    same = maps[found.pairs[:, 0]] == maps[found.pairs[:, 1]]
    found, keypoints = found.taken(np.flatnonzero(same)), context.keypoints
    tracks = build([found], np.diff(keypoints.starts))
    landmarks = place(tracks, keypoints, world_T_rigs, 6.0)
    return KeyframePlaces(keyframes, maps, features, replace(start, landmarks=landmarks), context)
