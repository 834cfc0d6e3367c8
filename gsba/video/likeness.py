"""Sharpness of panoramas and fisheyes, and apparent motion between successive ones."""

import cv2
import numpy as np

_BAND = (0.2, 0.8)  # used part of the height: without the poles and the carrier


def sharpness(grey: np.ndarray) -> float:
    """Mean squared Laplacian of an image (H, W) uint8, slightly smoothed against noise."""
    height = len(grey)
    band = grey[int(_BAND[0] * height) : int(_BAND[1] * height)]
    fine = cv2.Laplacian(cv2.GaussianBlur(band, (3, 3), 0), cv2.CV_32F, ksize=1)
    return float(cv2.mean(cv2.multiply(fine, fine))[0])


def miniature(grey: np.ndarray) -> np.ndarray:
    """Miniature, float32, of a panorama or of two fisheyes side by side, (H, 2H) uint8."""
    width = min(512, grey.shape[1])
    small = cv2.resize(grey, (width, width // 2), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0)


def lens_interior(height: int) -> np.ndarray:
    """Pixels (H, 2H) bool of two fisheyes side by side that are within every image circle."""
    v, u = np.ogrid[:height, : 2 * height]
    # within every fisheye's image circle
    return np.hypot(u % height + 0.5 - height / 2, v + 0.5 - height / 2) < 0.44 * height


def apparent_motion_deg(
    before: np.ndarray, after: np.ndarray, used: np.ndarray | None = None
) -> float:
    """Median normal flow between two miniatures, degrees.

    It follows from brightness constancy at the steepest pixels (Horn and Schunck, Artificial
    Intelligence 17, 1981). By the median, objects that move before a standing camera do not count.
    It only distinguishes motion from rest: flow of more than a pixel is underestimated. Two
    fisheyes side by side have about the angular width of a panorama.

    Args:
        before, after: miniatures (H, W).
        used: (H, W) bool, pixels to use; None = all.
    """
    height, width = before.shape
    rows = slice(int(_BAND[0] * height), int(_BAND[1] * height))
    gx = np.roll(before, -1, axis=1) - np.roll(before, 1, axis=1)
    gy = np.gradient(before, axis=0) * 2
    steepness = np.hypot(gx, gy)[rows] / 2
    inside = np.ones(steepness.shape, bool) if used is None else used[rows]
    steepness = np.where(inside, steepness, 0.0)
    edges = steepness >= max(float(np.quantile(steepness, 0.8)), 1e-6)  # the steepest fifth
    if not edges.any():
        return 0.0
    gain = float(np.median(((after[rows] + 1) / (before[rows] + 1))[inside]))  # of the exposure
    change = np.abs(after + 1 - gain * (before + 1))[rows]
    return float(np.median(change[edges] / steepness[edges])) * 360 / width
