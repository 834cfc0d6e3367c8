"""How sharp a panorama or a fisheye is, and whether it shows anything the one before did not."""

import cv2
import numpy as np

_BAND = (0.2, 0.8)  # part of the height: neither poles, nor what holds the camera
_SMALL = 512  # pixels across a miniature
_CIRCLE = 0.44  # radius of what is surely within a fisheye's image circle, heights
_EDGES = 0.2  # part of a miniature's pixels: those with the steepest gradient


def sharpness(grey: np.ndarray) -> float:
    """Mean squared Laplacian of a picture (H, W) uint8, lightly smoothed against noise."""
    height = len(grey)
    band = grey[int(_BAND[0] * height) : int(_BAND[1] * height)]
    fine = cv2.Laplacian(cv2.GaussianBlur(band, (3, 3), 0), cv2.CV_32F, ksize=1)
    return float(cv2.mean(cv2.multiply(fine, fine))[0])


def miniature(grey: np.ndarray) -> np.ndarray:
    """A panorama, or two fisheyes side by side, (H, 2H) uint8 `_SMALL` pixels across, float32."""
    width = min(_SMALL, grey.shape[1])
    small = cv2.resize(grey, (width, width // 2), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0)


def lens_interior(height: int) -> np.ndarray:
    """Pixels (H, 2H) bool of two fisheyes side by side that are well within the image circles."""
    v, u = np.ogrid[:height, : 2 * height]
    return np.hypot(u % height + 0.5 - height / 2, v + 0.5 - height / 2) < _CIRCLE * height


def apparent_motion_deg(
    before: np.ndarray, after: np.ndarray, looked_at: np.ndarray | None = None
) -> float:
    """Median normal flow between two miniatures, degrees: how far edges moved across themselves.

    Brightness constancy at the steepest pixels (Horn and Schunck, Artificial Intelligence 17,
    1981), so that what moves before a standing camera, being the minority, does not count. Only
    good for telling none from some: beyond a pixel it falls short. Two fisheyes side by side are
    about as many degrees across as a panorama, of which `looked_at` (H, W) bool says where to look.
    """
    height, width = before.shape
    rows = slice(int(_BAND[0] * height), int(_BAND[1] * height))
    gx = np.roll(before, -1, axis=1) - np.roll(before, 1, axis=1)
    gy = np.gradient(before, axis=0) * 2
    steepness = np.hypot(gx, gy)[rows] / 2
    inside = np.ones(steepness.shape, bool) if looked_at is None else looked_at[rows]
    steepness = np.where(inside, steepness, 0.0)
    edges = steepness >= max(float(np.quantile(steepness, 1 - _EDGES)), 1e-6)
    if not edges.any():
        return 0.0
    gain = float(np.median(((after[rows] + 1) / (before[rows] + 1))[inside]))  # of the exposure
    change = np.abs(after + 1 - gain * (before + 1))[rows]
    return float(np.median(change[edges] / steepness[edges])) * 360 / width
