"""Equirectangular pixels, the bearings that they show, and what lies beyond a picture's border."""

import numpy as np


def bearings_from_erp(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Unit bearings of equirectangular pixels.

    Args:
        pixels: (..., 2) float64, (u, v), centre of the top-left pixel at (0.5, 0.5).
        width, height: image size in pixels, width = 2 height.

    Returns:
        (..., 3) float64, rig frame (x right, y down, z forward = centre column).
    """
    longitude = 2 * np.pi * (pixels[..., 0] / width - 0.5)
    latitude = np.pi * (0.5 - pixels[..., 1] / height)
    c = np.cos(latitude)
    return np.stack([c * np.sin(longitude), -np.sin(latitude), c * np.cos(longitude)], axis=-1)


def erp_from_bearings(bearings: np.ndarray, width: int, height: int) -> np.ndarray:
    """Equirectangular pixels, (..., 2) float64 with u in [0, width], of vectors (..., 3)."""
    x, y, z = bearings[..., 0], bearings[..., 1], bearings[..., 2]
    u = width * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
    v = height * (0.5 + np.arctan2(y, np.hypot(x, z)) / np.pi)
    return np.stack([u, v], axis=-1)


def dense_enough(width: int, focal: float) -> int:
    """Width to average a panorama down to for pinhole images: detail beyond theirs aliases."""
    density = 2 * np.pi * focal  # panorama width at which pixels are as dense as in their middle
    return 2 * round(density / 2) if width > 1.5 * density else width


def around_seam(image: np.ndarray, columns: int) -> np.ndarray:
    """A panorama (h, 2h[, C]) with columns from beyond the seam on either side."""
    return np.concatenate([image[:, -columns:], image, image[:, :columns]], axis=1)


def around_sphere(image: np.ndarray, pad: int) -> np.ndarray:
    """A panorama (h, 2h[, C]) padded by what lies beyond seam and poles on the sphere."""
    from factors.patch_windows import over_poles

    return around_seam(over_poles(image, pad), pad)
