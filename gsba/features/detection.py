"""Keypoints on cube faces, as bearings of the rig."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from gsba.camera.rig import RIG_R_FACE, CubeRig, owner_faces
from gsba.config import FeatureSettings, RefineSettings
from gsba.disk import concatenated
from gsba.types import FACES, Features, Keypoints


@dataclass(frozen=True, slots=True)
class ExtractorTraits:
    """Traits of an extractor's keypoints and descriptors."""

    min_similarity: float  # cosine that 95 % of true matches exceed
    max_ratio: float  # ratio of distances, best over second best, below which 90 % of them are
    sigma_px: float | None = None  # per-axis noise, face pixels; None = by a keypoint's size
    offset_px: tuple[float, float] = (0.0, 0.0)  # (u, v) to add to the network's pixels
    patch_size: int = 27  # panorama pixels across the patches that are aligned around keypoints,
    # odd; smaller ones around those of networks drift along a walk (benchmarks/results/learned.md)


TRAITS = {
    "sift": ExtractorTraits(0.8, 0.9, patch_size=15),
    "aliked": ExtractorTraits(0.55, 0.95, 0.28, (-0.35, 0.1)),
    "disk": ExtractorTraits(0.55, 0.95, 0.37, (-0.45, -0.35)),
    "xfeat": ExtractorTraits(0.78, 0.97, 0.42, (-0.1, 1.05)),
    "superpoint": ExtractorTraits(0.8, 0.9, 0.5),  # not measured
}


def traits_of(settings: RefineSettings) -> ExtractorTraits:
    """Traits of a run's extractor."""
    return TRAITS[settings.features.extractor]


# Noise of SIFT keypoints along each axis, face pixels: of the smallest
# ones, and what is added in proportion to a keypoint's size.
SIGMA_PX, _SIGMA_PER_SIZE = 0.16, 0.033


@dataclass(frozen=True, slots=True)
class FaceKeypoints:
    """Keypoints that an extractor finds on one face."""

    pixels: np.ndarray  # (K, 2) float64, (u, v), corner origin
    sigmas_px: np.ndarray  # (K,) float64, per-axis localisation noise, face pixels
    descriptors: np.ndarray  # (K, D)
    scores: np.ndarray | None = None  # (K,) float32, a network's confidence


class Extractor(Protocol):
    """Detects and describes keypoints on a pinhole image, the strongest first."""

    def __call__(self, face_rgb: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        """Keypoints of a (N, N, 3) uint8 image where mask (N, N) bool is True."""
        ...


class SiftExtractor:
    """OpenCV SIFT (Lowe, IJCV 2004) with RootSIFT descriptors (Arandjelovic, CVPR 2012)."""

    def __init__(self, settings: FeatureSettings) -> None:
        self._sift = cv2.SIFT.create(
            nfeatures=settings.max_per_face,
            nOctaveLayers=3,
            contrastThreshold=settings.contrast_threshold,
            edgeThreshold=10,
            sigma=1.6,
            descriptorType=cv2.CV_32F,
            enable_precise_upscale=True,
        )

    def __call__(self, face_rgb: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        grey = cv2.cvtColor(face_rgb, cv2.COLOR_RGB2GRAY)
        allowed = None if mask is None else mask.astype(np.uint8)
        keypoints, descriptors = self._sift.detectAndCompute(grey, allowed)
        if descriptors is None:
            return FaceKeypoints(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
        responses, sizes = np.array([(k.response, k.size) for k in keypoints]).T
        order = np.argsort(-responses, kind="stable")
        places = np.asarray(cv2.KeyPoint.convert(keypoints), float)
        pixels, descriptors = places[order] + 0.5, descriptors[order]
        sigmas = np.hypot(SIGMA_PX, _SIGMA_PER_SIZE * sizes[order])
        # Hellinger-normalised, quantised with factor 512
        mass = descriptors.sum(axis=1, keepdims=True)
        rooted = np.rint(512 * np.sqrt(descriptors / np.maximum(mass, 1e-12)))
        return FaceKeypoints(pixels, sigmas, np.minimum(rooted, 255).astype(np.uint8))


def extract(
    faces_rgb: np.ndarray, masks: np.ndarray | None, rig: CubeRig, extractor: Extractor
) -> Features:
    """Find keypoints on all faces (6, N, N, 3) uint8 of a frame, FACES order, where masks (6, N, N)
    are True; each stays only in the face that owns its bearing."""
    wanted = _owned_pixels(rig) if masks is None else _owned_pixels(rig) & masks
    usable = [face for face in range(len(FACES)) if wanted[face].any()]
    parts, scores = [], []
    for face in usable or [0]:  # one at least: the extractor's descriptor has a shape even without
        # keypoints
        found = extractor(faces_rgb[face], wanted[face])
        bearings = rig.bearings(found.pixels, face)
        own = owner_faces(bearings) == face
        pixels = found.pixels[own]
        # A pixel at angle a off the axis subtends cos^2 a radially and cos a tangentially of 1 / f;
        # the geometric mean keeps the noise isotropic.
        cosine = bearings[own] @ RIG_R_FACE[face, :, 2]
        sigmas = found.sigmas_px[own] / rig.focal * cosine**1.5
        columns, rows = np.minimum(pixels, rig.size - 1).astype(int).T
        colors = faces_rgb[face][rows, columns]
        owners = np.full(len(pixels), face, np.uint8)
        parts.append((pixels, owners, bearings[own], sigmas, found.descriptors[own], colors))
        if found.scores is not None:
            scores.append(found.scores[own])
    features = Features(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return replace(features, scores=np.concatenate(scores)) if scores else features


@lru_cache(maxsize=2)
def _owned_pixels(rig: CubeRig) -> np.ndarray:
    """Pixels (6, N, N) bool at or beside those that a face owns; other keypoints are dropped."""
    centres = np.arange(rig.size) + 0.5
    grid = np.stack(np.meshgrid(centres, centres), axis=-1)
    owned = [owner_faces(rig.bearings(grid, face)) == face for face in range(len(FACES))]
    border = np.ones((3, 3), np.uint8)
    return np.stack([cv2.dilate(own.astype(np.uint8), border) > 0 for own in owned])


def gather(frames: Iterable[Features], folder: Path | None = None) -> Keypoints:
    """Keypoints of all frames in one record, without descriptors. `folder`: on the disk that holds
    the arrays while they are used; None = they are in memory."""
    lengths = [0]

    def columns() -> Iterator[tuple[np.ndarray, ...]]:
        for found in frames:
            lengths.append(len(found))
            yield found.pixels, found.faces, found.bearings_rig, found.sigmas_rad, found.colors

    arrays = concatenated(columns(), folder)
    return Keypoints(np.cumsum(lengths), *arrays)


def on_faces(keypoints: Keypoints, rig: CubeRig) -> Keypoints:
    """Keypoints whose pixels are given on the faces of a rig, where they were on others; keypoints:
    of frames of several runs, each on the faces of its own rig."""
    pixels = rig.project(keypoints.bearings_rig, keypoints.faces)
    moved = np.abs(pixels - keypoints.pixels).max(axis=1, initial=0.0) > 0.01  # pixels
    if not moved.any():
        return keypoints
    return replace(keypoints, pixels=np.where(moved[:, None], pixels, keypoints.pixels))
