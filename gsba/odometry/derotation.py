"""Rotation between two frames from their panoramas alone, at any angle: rows are correlated for the
yaw, then the whole sphere is aligned over SO(3) (Gauss-Newton, inverse compositional)."""

from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.sphere import around_sphere, bearings_from_erp, erp_from_bearings, table

_WIDTH = 128  # pixels across the panoramas that are compared
PAD = 2  # pixels beyond seam and poles for interpolation


@dataclass(frozen=True, slots=True)
class Miniature:
    """Band-passed panorama of unit standard deviation."""

    detail: np.ndarray  # (64, 128) float32
    weights: np.ndarray  # (64, 128) float32, solid angle; 0 = masked
    contrast: float  # grey values, standard deviation of the detail before scaling


def miniature(grey: np.ndarray, usable: np.ndarray | None = None) -> Miniature:
    """Band-passed small copy of a panorama (h, 2h) uint8; `usable` (h, 2h) bool masks the scene."""
    size = (_WIDTH, _WIDTH // 2)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    wide = np.concatenate([small[:, -32:], small, small[:, :32]], axis=1)
    fine, coarse = (cv2.GaussianBlur(wide, (0, 0), sigma)[:, 32:-32] for sigma in (1.2, 8.0))
    detail = fine - coarse
    heights = (np.arange(len(small)) + 0.5) / len(small)
    weights = np.repeat(np.sin(np.pi * heights)[:, None], _WIDTH, axis=1).astype(np.float32)
    if usable is not None:
        share = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        weights = weights * (share > 0.9)
    spread = float(np.sqrt(np.average(detail**2, weights=weights))) if weights.any() else 0.0
    return Miniature(detail / max(spread, 1e-3), weights, spread)


def turned(one: Miniature, other: Miniature, guesses: list[np.ndarray]) -> np.ndarray:
    """one_R_other (3, 3) that best aligns the two panoramas, of nearby positions, from guesses and
    from the best rotation about the vertical axis."""
    best, least = np.eye(3), np.inf
    # the middle half of the rows is correlated
    rows = slice(*(round(part * len(one.detail)) for part in (0.25, 0.75)))
    spectra = [np.fft.rfft(m.detail[rows] * (m.weights[rows] > 0), axis=1) for m in (one, other)]
    correlation = np.fft.irfft(spectra[0] * np.conj(spectra[1]), axis=1).sum(axis=0)
    angle = 2 * np.pi * int(np.argmax(correlation)) / _WIDTH
    c, s = np.cos(angle), np.sin(angle)
    for start in [*guesses, np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])]:
        rotation, cost = _aligned(one, other, start)
        if cost < least:
            best, least = rotation, cost
    return best


def _aligned(one: Miniature, other: Miniature, start: np.ndarray) -> tuple[np.ndarray, float]:
    """one_R_other near `start`, and the mean robust cost of the residuals."""
    from scipy.spatial.transform import Rotation

    rays, rotation, cost = _rays(), start, np.inf
    weights = one.weights.ravel()
    per_radian = _WIDTH / (2 * np.pi)
    by_u = 0.5 * (np.roll(one.detail, -1, axis=1) - np.roll(one.detail, 1, axis=1)) * per_radian
    by_v = np.gradient(one.detail, axis=0) * per_radian
    x, y, z = rays.T
    level = np.maximum(np.hypot(x, z), 0.05)
    # Rotating a ray r about w moves it by w x r: longitude and elevation angles follow.
    by_longitude, by_height = by_u.ravel(), by_v.ravel()
    east = np.stack([z, np.zeros_like(x), -x], axis=1) / level[:, None]
    down = np.stack([-x * y, level**2, -z * y], axis=1) / level[:, None]
    gradient = by_longitude[:, None] / level[:, None] * east + by_height[:, None] * down
    jacobian = np.cross(rays, gradient)
    for _ in range(15):
        # The other picture, rotated by the estimate, is compared at the rays of the first.
        places = erp_from_bearings(rays @ rotation, _WIDTH, _WIDTH // 2) - 0.5
        maps = np.ascontiguousarray(places, np.float32).reshape(-1, _WIDTH, 2)
        sampled, seen = _sampled(other.detail, maps), _sampled(other.weights, maps)
        residuals = (sampled - one.detail).ravel()
        both = weights * (seen.ravel() > 0)
        robust = both / (1 + residuals**2)
        cost = float(np.sum(both * np.log1p(residuals**2)) / max(both.sum(), 1e-6))
        weighted = jacobian * robust[:, None]
        normal = weighted.T @ jacobian + 1e-6 * np.eye(3)
        step = np.linalg.solve(normal, weighted.T @ residuals)
        step *= min(1.0, np.deg2rad(15.0) / max(float(np.linalg.norm(step)), 1e-12))
        rotation = Rotation.from_rotvec(step).as_matrix() @ rotation
        if np.linalg.norm(step) < np.deg2rad(0.05):
            break
    return rotation, cost


def _sampled(image: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """A panorama at OpenCV pixels (h, w, 2)."""
    padded = around_sphere(image, PAD)
    u, v = maps[..., 0] + PAD, maps[..., 1] + PAD
    return cv2.remap(padded, u, v, cv2.INTER_LINEAR)


@table(maxsize=1)
def _rays() -> np.ndarray:
    """Bearings (64 * 128, 3) of the pixels."""
    v, u = np.mgrid[: _WIDTH // 2, :_WIDTH] + 0.5
    rays = bearings_from_erp(np.stack([u, v], axis=-1), _WIDTH, _WIDTH // 2).reshape(-1, 3)
    rays.setflags(write=False)
    return rays
