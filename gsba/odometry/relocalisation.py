"""Relocalisation of a lost frame by a keyframe's descriptors, at the scale of the map's points."""

from dataclasses import dataclass

import cv2
import numpy as np

from gsba.geometry import pose
from gsba.matching.verification import relative_pose
from gsba.odometry.atlas import Atlas, AtlasLayout
from gsba.trajectory.limits import TwoViewLimits

_MIN_MATCHES = 20
_VERIFY = TwoViewLimits(max_error_deg=0.4)


@dataclass(frozen=True, slots=True)
class Described:
    """Keypoints of an atlas."""

    bearings_rig: np.ndarray  # (K, 3) unit
    descriptors: np.ndarray  # (K, 128) float32, root SIFT


def describe(layout: AtlasLayout, atlas: Atlas, usable: np.ndarray | None) -> Described:
    """SIFT keypoints of an atlas, each in the face that owns it. `usable`: (2 s, 3 s) bool, pixels
    of the scene; None = all."""
    allowed = layout.owned if usable is None else layout.owned & usable
    sift = cv2.SIFT.create(1500, 3, 0.02, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(atlas.image, allowed.astype(np.uint8) * 255)
    if descriptors is None:
        return Described(np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    pixels = np.array([keypoint.pt for keypoint in found], np.float64)
    column, row = (np.clip(pixels // layout.rig.size, 0, [2, 1])).astype(int).T
    bearings = layout.bearings(pixels, row * 3 + column) @ atlas.cut_R_rig
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return Described(bearings, np.sqrt(descriptors / total).astype(np.float32))


def placed(
    key: Described, frame: Described, bearings: np.ndarray, distances: np.ndarray, seed: int
) -> np.ndarray | None:
    """key_T_rig (4, 4) of a frame, in the unit of the map, by keypoints of the keyframe and the
    frame; None if it is uncertain. Points of the keyframe are along unit bearings (P, 3), rig
    frame, at distances (P,), map units."""
    if min(len(key.bearings_rig), len(frame.bearings_rig)) < _MIN_MATCHES:
        return None
    # mutual nearest neighbours that pass the ratio test
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forth = matcher.knnMatch(key.descriptors, frame.descriptors, k=2)
    back = {
        m[0].queryIdx: m[0].trainIdx
        for m in matcher.knnMatch(frame.descriptors, key.descriptors, k=1)
        if m
    }
    pairs = [
        (m[0].queryIdx, m[0].trainIdx)
        for m in forth
        if len(m) == 2
        and m[0].distance < 0.85 * m[1].distance
        and back.get(m[0].trainIdx) == m[0].queryIdx
    ]
    rows = np.array(pairs, np.int64).reshape(-1, 2)
    if len(rows) < _MIN_MATCHES:
        return None
    one, other = key.bearings_rig[rows[:, 0]], frame.bearings_rig[rows[:, 1]]
    found = relative_pose(one, other, _VERIFY, seed)
    if found is None:
        return None
    rotation, direction = found.f0_T_f1[:3, :3], found.f0_T_f1[:3, 3]
    if np.isinf(found.direction_sigma):
        return pose(rotation, np.zeros(3))
    one, other = one[found.inliers], other[found.inliers] @ rotation.T
    length = _length(one, other, direction, bearings, distances)
    return None if length is None else pose(rotation, length * direction)


def _length(
    one: np.ndarray,
    other: np.ndarray,
    direction: np.ndarray,
    bearings: np.ndarray,
    distances: np.ndarray,
) -> float | None:
    """Length of the step at which matches have the distances of nearby points; or None."""
    from scipy.spatial import KDTree

    if not len(bearings):
        return None
    parallax = np.linalg.norm(np.cross(one, other), axis=1)
    apart, nearest = KDTree(bearings).query(one)
    # a match takes the distance of a point within 4 degrees
    use = (parallax > np.deg2rad(1.0)) & (apart < np.deg2rad(4.0))
    if np.count_nonzero(use) < 8:  # least number of matches near a point
        return None
    # |step x other| / |one x other| is the distance along `one` at a step of length 1.
    at_one = np.linalg.norm(np.cross(direction, other[use]), axis=1) / parallax[use]
    lengths = distances[np.asarray(nearest)[use]] / np.maximum(at_one, 1e-9)
    return float(np.median(lengths))
