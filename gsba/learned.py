"""Learned keypoints by kornia (extra `learned`): ALIKED and DISK, with weights from a file.

Nothing is downloaded. The weights are their authors', under their own licences; where to get them
is said when they are missing. What is found is matched like SIFT: guided by the poses.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from gsba.config import FeatureSettings
from gsba.features import FaceKeypoints
from gsba.log import GsbaError

SIGMA_PX = 0.5  # per-axis noise of either; what matters is that all have the same
_SOURCES = {  # weights file, licence, place
    "aliked": ("aliked-n16.pth", "BSD-3-Clause", "https://github.com/Shiaoming/ALIKED (models/)"),
    "disk": ("depth-save.pth", "Apache-2.0", "https://github.com/cvlab-epfl/disk"),
}
_STEP = 32  # pixels; both networks halve the image several times


class LearnedExtractor:
    """ALIKED (Zhao et al., TIM 2023) or DISK (Tyszkiewicz et al., NeurIPS 2020) on one face.

    Args:
        settings: `extractor` names the network, `weights` its file.

    Raises:
        GsbaError: no weights, weights of another network, or kornia is not installed.
    """

    def __init__(self, settings: FeatureSettings) -> None:
        check_weights(settings)
        self._settings = settings
        self._model = _load(settings.extractor, str(settings.weights), settings.max_per_face)

    def __call__(self, face_rgb: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        import torch  # pyright: ignore[reportMissingImports]

        size = face_rgb.shape[0]
        side = -(-size // _STEP) * _STEP
        padded = np.pad(face_rgb, ((0, side - size), (0, side - size), (0, 0)), mode="edge")
        image = torch.from_numpy(np.moveaxis(padded, -1, 0).astype(np.float32) / 255)[None]
        with torch.inference_mode():
            if self._settings.extractor == "disk":
                found = self._model(image, n=2 * self._settings.max_per_face)[0]
                scores = found.detection_scores
            else:
                found = self._model(image)[0]
                scores = found.keypoint_scores
        pixels = found.keypoints.numpy().astype(np.float64) + 0.5  # from the centre of the first
        allowed = (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1)
        columns, rows = np.minimum(np.maximum(pixels, 0), size - 1).astype(int).T
        if mask is not None:
            allowed &= mask[rows, columns]
        kept = np.flatnonzero(allowed)
        kept = kept[np.argsort(-scores.numpy()[kept], kind="stable")][: self._settings.max_per_face]
        descriptors = found.descriptors.numpy().astype(np.float32)[kept]
        return FaceKeypoints(pixels[kept], np.full(len(kept), SIGMA_PX), descriptors)


def check_weights(settings: FeatureSettings) -> None:
    """Raise GsbaError where the weights of the chosen network are not named or not there."""
    file, licence, place = _SOURCES[settings.extractor]
    how = f"get {file} ({licence}) from {place} and set features.weights to it"
    if settings.weights is None:
        raise GsbaError(f"features.extractor = {settings.extractor} needs weights: {how}")
    if not Path(settings.weights).is_file():
        raise GsbaError(f"{settings.weights}: no such weights file; {how}")


@functools.lru_cache(maxsize=1)
def _load(name: str, weights: str, max_per_face: int) -> Any:
    """The network in inference mode; one for all threads."""
    try:
        import kornia.feature  # pyright: ignore[reportMissingImports]
        import torch  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise GsbaError(
            f"features.extractor = {name} needs kornia and torch: pip install 'gsba[learned]'"
        ) from None
    try:
        state = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as error:  # of pickle, zipfile or torch, each in its own words
        raise GsbaError(f"{weights}: not a file of weights; get it again") from error
    if name == "disk":
        model, state = kornia.feature.DISK(), dict(state).get("extractor", state)
    else:
        model = kornia.feature.ALIKED("aliked-n16", max_num_keypoints=2 * max_per_face)
    try:
        missing, unexpected = model.load_state_dict(state, strict=False)
    except (RuntimeError, TypeError, AttributeError):
        missing, unexpected = ["all"], []
    if missing or unexpected:
        raise GsbaError(f"{weights}: weights of another network than {name} ({_SOURCES[name][0]})")
    return model.eval()
