"""Learned matchers between the faces of two frames that see the same things."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gsba.camera.rig import owner_faces
from gsba.config import MatchingSettings, RefineSettings
from gsba.features.detection import FaceKeypoints
from gsba.learned.interfaces import FaceNetwork
from gsba.learned.weights import missing_library
from gsba.matching.guided_search import (
    Gate,
    Matcher,
    SearchableFrames,
    guided,
    one_to_one,
    strongest_of,
    within_gate,
)
from gsba.types import FACES, Features

_PARALLAX_RAD = np.deg2rad(10.0)  # that a pair of faces is expected to differ by
_MIN_SHARE = 0.05  # of a face's keypoints that the other one must be expected to see
_MIN_KEYPOINTS = 8  # on either face


def make_matcher(settings: RefineSettings, weights: Mapping[str, Path], size: int) -> Matcher:
    """The matcher that settings choose: our own search, or a learned one.

    Args:
        settings: `matching.matcher` and `features.extractor`.
        weights: files of learned networks (`find_weights`).
        size: pixels of a face.

    Raises:
        GsbaError: weights of another network, or a library is not installed.
    """
    name = settings.matching.matcher
    if name == "guided":
        return guided
    try:
        if name == "superglue":
            from gsba.learned.magicleap import SuperGlue

            return FaceMatcher(SuperGlue(weights["matching"]), size)
        from gsba.learned.lightglue import LightGlue

        return FaceMatcher(LightGlue(settings.features.extractor, weights["matching"]), size)
    except ImportError:
        raise missing_library(f"matching.matcher = {name}") from None


class FaceMatcher:
    """A Matcher (`gsba.matching.guided_search`) that asks a network, face by face.

    It takes the place of guided search wherever descriptors decide: between neighbours in time,
    along epipolar lines, and at loops. The network sees only pairs of faces that the predicted
    pose lets overlap, and of what it says only matches inside the gate are believed: what merely
    repeats is refused here as in guided search, and then by two-view verification. Where the map
    already knows a point to a fraction of a degree, and where nothing is predicted, `guided`
    remains.
    """

    def __init__(self, network: FaceNetwork, size: int) -> None:
        self._network, self._size = network, size

    def __call__(
        self,
        frames: SearchableFrames,
        pair: tuple[int, int],
        f0_T_f1: np.ndarray,
        gate: Gate,
        settings: MatchingSettings,
        points_f0: np.ndarray | None = None,
    ) -> np.ndarray:
        first, second = (frames.features(frame) for frame in pair)
        chosen = [strongest_of(found, frames.strongest) for found in (first, second)]
        bearings = first.bearings_rig[chosen[0]], second.bearings_rig[chosen[1]]
        rows, scores = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        for faces in overlapping_faces(*bearings, f0_T_f1):
            k0, k1 = (
                some[found.faces[some] == face]
                for some, found, face in zip(chosen, (first, second), faces, strict=True)
            )
            if min(len(k0), len(k1)) < _MIN_KEYPOINTS:
                continue
            matched, score = self._network(_on_face(first, k0), _on_face(second, k1), self._size)
            rows.append(np.column_stack([k0[matched[:, 0]], k1[matched[:, 1]]]))
            scores.append(score)
        found = np.concatenate(rows)
        inside = within_gate(found, first, second, f0_T_f1, gate, points_f0)
        return one_to_one(found[inside], np.concatenate(scores)[inside])


def _on_face(features: Features, keypoints: np.ndarray) -> FaceKeypoints:
    """Some keypoints of one face."""
    return FaceKeypoints(
        features.pixels[keypoints],
        features.sigmas_rad[keypoints],
        features.descriptors[keypoints],
        None if features.scores is None else features.scores[keypoints],
    )


def overlapping_faces(
    bearings0: np.ndarray, bearings1: np.ndarray, f0_T_f1: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs of faces, of frame 0 and frame 1, that should see the same things.

    At least a twentieth of the keypoints of one must lie on the other, if far away or if near
    enough to be seen 10 degrees off.

    Args:
        bearings0, bearings1: (n, 3) keypoints of both frames, each in its own rig frame.
        f0_T_f1: (4, 4) predicted pose of frame 1 in frame 0; its translation's length is unused.
    """
    rotation, motion = f0_T_f1[:3, :3], f0_T_f1[:3, 3]
    onto1 = _shares(bearings0, bearings0 @ rotation, -motion @ rotation)
    onto0 = _shares(bearings1, bearings1 @ rotation.T, motion)
    overlap = np.maximum(onto1, onto0.T) >= _MIN_SHARE
    return [(int(face0), int(face1)) for face0, face1 in np.argwhere(overlap)]


def _shares(bearings: np.ndarray, seen: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Parts (6, 6) of each face's keypoints that may lie on each face of the other frame.

    Args:
        bearings: (n, 3) in their own frame.
        seen: (n, 3) the same directions in the other frame.
        towards: (3,) where bearings of near points are displaced to, in the other frame.
    """
    faces, length = owner_faces(bearings), np.linalg.norm(towards)
    places = [owner_faces(seen)]
    if length > 1e-12:
        target = towards / length
        cosine = seen @ target
        aside = target - cosine[:, None] * seen
        aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
        angle = np.minimum(_PARALLAX_RAD, np.arccos(np.clip(cosine, -1, 1)))[:, None]
        places.append(owner_faces(np.cos(angle) * seen + np.sin(angle) * aside))
    counts = np.zeros((len(FACES), len(FACES)))
    for face in range(len(FACES)):
        on = np.zeros((len(FACES), len(bearings)), bool)
        for place in places:
            on[place, np.arange(len(bearings))] = True
        counts[:, face] = np.bincount(faces[on[face]], minlength=len(FACES))
    return counts / np.maximum(np.bincount(faces, minlength=len(FACES)), 1)[:, None]
