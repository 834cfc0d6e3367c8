"""Learned matchers between overlapping faces of two frames."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path

import numpy as np

from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import RefineSettings
from gsba.features.detection import ExtractorTraits, FaceKeypoints
from gsba.learned.interfaces import FaceNetwork
from gsba.learned.weights import missing_library
from gsba.matching.guided_search import (
    Gate,
    Matcher,
    SearchableFrames,
    guided,
    mutual_nearest,
    one_to_one,
    strongest_of,
    within_gate,
)
from gsba.types import FACES, Features

# Pairs of faces that may show the same where the heading is unknown, as cameras are held upright.
_UPRIGHT_FACES = [*product(range(4), range(4)), (4, 4), (5, 5)]
# Half of the pairs of faces have nine tenths of the true matches (benchmarks/results/tours.md).
_MIN_ALIKE_SHARE = 0.1  # of a face's mutual nearest neighbours


def make_matcher(settings: RefineSettings, weights: Mapping[str, Path], rig: CubeRig) -> Matcher:
    """Matcher that `matching.matcher` and `features.extractor` choose for faces of a rig: guided
    search, or a learned network with weights by `find_weights`. GsbaError: the weights are of
    another network, or a library is not installed."""
    name = settings.matching.matcher
    if name == "guided":
        return guided
    try:
        if name == "superglue":
            from gsba.learned.magicleap import SuperGlue

            return FaceMatcher(SuperGlue(weights["matching"]), rig)
        from gsba.learned.lightglue import LightGlue

        return FaceMatcher(LightGlue(settings.features.extractor, weights["matching"]), rig)
    except ImportError:
        raise missing_library(f"matching.matcher = {name}") from None


class FaceMatcher:
    """Matcher (`gsba.matching.guided_search`) that applies a network to pairs of faces.

    It replaces guided search between neighbours in time, along epipolar lines, at loops, and where
    nothing predicts the pose of neighbours. The network gets only pairs of faces that overlap by
    the predicted pose, and only its matches inside the gate are kept, so that the gate and then
    two-view verification remove matches of repetitive structure. Without a prediction, sides may
    overlap with sides, up with up and down with down. Of all these, only the faces most alike
    are compared. Known points with a gate of a fraction of a degree are matched by `guided`.
    """

    def __init__(self, network: FaceNetwork, rig: CubeRig) -> None:
        self._network, self._rig = network, rig

    def __call__(
        self,
        frames: SearchableFrames,
        pair: tuple[int, int],
        f0_T_f1: np.ndarray,
        gate: Gate,
        traits: ExtractorTraits,
        points_f0: np.ndarray | None = None,
    ) -> np.ndarray:
        first, second = (frames.features(frame) for frame in pair)
        chosen = [strongest_of(found, frames.strongest) for found in (first, second)]
        (bearings0, faces0, descriptors0), (bearings1, faces1, descriptors1) = (
            (found.bearings_rig[some], found.faces[some], found.descriptors[some])
            for some, found in zip(chosen, (first, second), strict=True)
        )
        rows, scores = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
        alike = likeness(faces0, faces1, descriptors0, descriptors1)
        if gate.is_prediction or points_f0 is not None:
            compared = overlapping_faces(bearings0, bearings1, f0_T_f1)
        else:
            by_likeness = sorted(_UPRIGHT_FACES, key=alike.__getitem__, reverse=True)
            compared = by_likeness[:9]
        for faces in compared:
            if alike[faces] < _MIN_ALIKE_SHARE:
                continue
            k0, k1 = (
                some[found.faces[some] == face]
                for some, found, face in zip(chosen, (first, second), faces, strict=True)
            )
            if min(len(k0), len(k1)) < 8:
                continue
            shown = self._on_face(first, k0), self._on_face(second, k1)
            matched, score = self._network(*shown, self._rig.size)
            rows.append(np.column_stack([k0[matched[:, 0]], k1[matched[:, 1]]]))
            scores.append(score)
        found = np.concatenate(rows)
        inside = within_gate(found, first, second, f0_T_f1, gate, points_f0)
        return one_to_one(found[inside], np.concatenate(scores)[inside])

    def _on_face(self, features: Features, keypoints: np.ndarray) -> FaceKeypoints:
        """Keypoints `keypoints` (n,) of one face, as the rig shows it: frames of another run may
        have been searched on faces of another size."""
        return FaceKeypoints(
            self._rig.project(features.bearings_rig[keypoints], features.faces[keypoints]),
            features.sigmas_rad[keypoints],
            features.descriptors[keypoints],
            None if features.scores is None else features.scores[keypoints],
        )


def likeness(
    faces0: np.ndarray, faces1: np.ndarray, descriptors0: np.ndarray, descriptors1: np.ndarray
) -> np.ndarray:
    """Likeness (6, 6) of faces of frames 0 and 1: mutual nearest neighbours of both faces, as a
    share of those of the face with fewer, by the faces (n,) and descriptors (n, D) of keypoints."""
    rows0, rows1 = mutual_nearest(descriptors0, descriptors1)
    counts = np.zeros((len(FACES), len(FACES)))
    np.add.at(counts, (faces0[rows0], faces1[rows1]), 1)
    fewer = np.minimum(counts.sum(axis=1)[:, None], counts.sum(axis=0))
    return counts / np.maximum(fewer, 1)


def overlapping_faces(
    bearings0: np.ndarray, bearings1: np.ndarray, f0_T_f1: np.ndarray
) -> list[tuple[int, int]]:
    """Pairs of overlapping faces of frames 0 and 1, whose keypoints are (n, 3) in either's rig
    frame; f0_T_f1: (4, 4) predicted, its translation's length is unused.

    At least a twentieth of the keypoints of one must be on the other, for points at infinity or
    with a parallax of 10 degrees.
    """
    rotation, motion = f0_T_f1[:3, :3], f0_T_f1[:3, 3]
    onto1 = _shares(bearings0, bearings0 @ rotation, -motion @ rotation)
    onto0 = _shares(bearings1, bearings1 @ rotation.T, motion)
    overlap = np.maximum(onto1, onto0.T) >= 0.05
    return [(int(face0), int(face1)) for face0, face1 in np.argwhere(overlap)]


def _shares(bearings: np.ndarray, seen: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Shares (6, 6) of each face's keypoints that may be on each face of the other frame."""
    faces, length = owner_faces(bearings), np.linalg.norm(towards)
    places = [owner_faces(seen)]
    if length > 1e-12:
        target = towards / length
        cosine = seen @ target
        aside = target - cosine[:, None] * seen
        aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12)
        # parallax of near points
        angle = np.minimum(np.deg2rad(10.0), np.arccos(np.clip(cosine, -1, 1)))[:, None]
        places.append(owner_faces(np.cos(angle) * seen + np.sin(angle) * aside))
    counts = np.zeros((len(FACES), len(FACES)))
    for face in range(len(FACES)):
        on = np.zeros((len(FACES), len(bearings)), bool)
        for place in places:
            on[place, np.arange(len(bearings))] = True
        counts[:, face] = np.bincount(faces[on[face]], minlength=len(FACES))
    return counts / np.maximum(np.bincount(faces, minlength=len(FACES)), 1)[:, None]
