"""Interfaces of networks that `LearnedExtractor` and `FaceMatcher` call."""

from typing import Protocol

import numpy as np

from gsba.features.detection import FaceKeypoints


class Detector(Protocol):
    """Network that detects and describes keypoints on one image."""

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, ...]:
        """Keypoints of an image (N, N, 3) uint8, N a multiple of 32: pixels (K, 2) (u, v), with the
        origin in the centre of the first pixel, scores (K,), and descriptors (K, D) float32 of
        length one."""
        ...


class FaceNetwork(Protocol):
    """Network that matches the keypoints of two images of `size` by `size` pixels."""

    def __call__(
        self, first: FaceKeypoints, second: FaceKeypoints, size: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Matches (m, 2) and their scores (m,)."""
        ...
