"""Extractor for all learned networks: padding, masks, pixel conventions, selection."""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gsba.config import FeatureSettings
from gsba.features.detection import TRAITS, Extractor, FaceKeypoints, SiftExtractor
from gsba.learned.interfaces import Detector
from gsba.learned.weights import missing_library

_SIZE_MULTIPLE_PX = 32  # of network inputs, which are halved several times


def make_extractor(
    settings: FeatureSettings, weights: Mapping[str, Path]
) -> Callable[[], Extractor]:
    """Factory of the extractor for each frame: SIFT, or a learned network; weights: files of
    learned networks (`find_weights`)."""
    if settings.extractor == "sift":
        return functools.partial(SiftExtractor, settings)
    return functools.partial(LearnedExtractor, settings, weights["features"])


class LearnedExtractor:
    """ALIKED, DISK, XFeat or SuperPoint, as `settings.extractor` names it, on one face, without
    rescaling. GsbaError: the weights are of another network, or a library is not installed."""

    def __init__(self, settings: FeatureSettings, weights: Path) -> None:
        self._most, self._traits = settings.max_per_face, TRAITS[settings.extractor]
        self._detect = _load(settings.extractor, weights, settings.max_per_face)

    def __call__(self, face_rgb: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        size = face_rgb.shape[0]
        side = -(-size // _SIZE_MULTIPLE_PX) * _SIZE_MULTIPLE_PX
        padded = np.pad(face_rgb, ((0, side - size), (0, side - size), (0, 0)), mode="edge")
        centred, scores, descriptors = self._detect(padded)
        pixels = centred.astype(np.float64).reshape(-1, 2) + 0.5  # corner origin
        pixels += self._traits.offset_px
        allowed = (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
        columns, rows = np.minimum(np.maximum(pixels, 0), size - 1).astype(int).T
        if mask is not None:
            allowed &= mask[rows, columns]
        kept = np.flatnonzero(allowed)
        kept = kept[np.argsort(-scores[kept], kind="stable")][: self._most]
        return FaceKeypoints(
            pixels[kept],
            np.full(len(kept), self._traits.sigma_px),
            descriptors[kept].astype(np.float32),
            scores[kept].astype(np.float32),
        )


@functools.lru_cache(maxsize=1)
def _load(name: str, weights: Path, max_per_face: int) -> Detector:
    """Network in inference mode, with twice the kept keypoints: masks and faces remove some."""
    try:
        if name == "superpoint":
            from gsba.learned.magicleap import superpoint as load
        else:
            from gsba.learned import detectors

            load = {"aliked": detectors.aliked, "disk": detectors.disk, "xfeat": detectors.xfeat}[
                name
            ]
        return load(weights, 2 * max_per_face)
    except ImportError:
        raise missing_library(f"features.extractor = {name}") from None
