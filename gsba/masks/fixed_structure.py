"""Stability of local structure's direction, in the rig frame, while the camera moves.

Around every direction, the gradients of each frame are correlated with their mean over the frames.
The carrier agrees in nearly every frame. The world agrees in none, except for edges that the motion
shifts along themselves: a rail at the horizon, the line where a corridor meets its floor. They
agree along one direction alone, so the gradients along the weaker principal direction of the
structure tensor (Förstner, Gülch, ISPRS 1987) are correlated separately.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from gsba.camera.sphere import around_sphere
from gsba.masks.medians import median_picture

_PADDING_PX = 16  # pixels padded around pictures
_WINDOW_SIGMA_PX, _WINDOW_SIZE = 2.0, (7, 7)  # pixels, standard deviation and extent, around a
# direction


@dataclass(frozen=True, slots=True)
class FixedStructure:
    """Correlation of frames with their mean, -1..1, in all but the worst frames."""

    strong: np.ndarray  # (h, 2h) float32, of all gradients around a direction
    weak: np.ndarray  # (h, 2h) float32, of those along the weaker principal direction
    textured: np.ndarray  # (h, 2h) bool, structure above noise in most frames


def measure_fixed_structure(pictures: np.ndarray) -> FixedStructure:
    """Correlate frames, direction by direction.

    Args:
        pictures: (K, h, 2h, 3) uint8 panoramas, some hundred pixels across: structure counts as
            fixed up to about half a pixel.
    """
    across, down = np.stack([_gradients(picture) for picture in pictures], axis=1)
    u, v = across.mean(axis=0), down.mean(axis=0)
    window = partial(cv2.GaussianBlur, ksize=_WINDOW_SIZE, sigmaX=_WINDOW_SIGMA_PX)
    uu, uv, vv = (window(_dot(a, b)) for a, b in ((u, u), (u, v), (v, v)))
    strong_angle = 0.5 * np.arctan2(2 * uv, uu - vv)
    a, b = -np.sin(strong_angle)[..., None], np.cos(strong_angle)[..., None]
    weak = a * u + b * v
    energy, weak_energy = uu + vv, window(_dot(weak, weak))
    # grey levels per pixel and channel: gradients of noise, JPEG and smooth shading
    noise = np.float32(u.shape[-1] * 3.0**2)
    correlations, energies = [], []
    for x, y in zip(across, down, strict=True):
        own, along = window(_dot(x, x) + _dot(y, y)), a * x + b * y
        shared, shared_weak = window(_dot(x, u) + _dot(y, v)), window(_dot(along, weak))
        own_weak = window(_dot(along, along))
        strong_scale = np.sqrt((own + noise) * np.maximum(energy, 1e-6))
        weak_scale = np.sqrt((own_weak + noise / 2) * np.maximum(weak_energy, 1e-6))
        correlations.append((shared / strong_scale, shared_weak / weak_scale))
        energies.append(own)
    # a passing shadow or hand may hide the carrier
    worst = np.quantile(np.array(correlations), 0.1, axis=0).astype(np.float32)
    textured = median_picture(np.array(energies)) > noise
    return FixedStructure(
        *(x[_PADDING_PX:-_PADDING_PX, _PADDING_PX:-_PADDING_PX] for x in (*worst, textured))
    )


def _gradients(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients right and down, (h + 2 pad, 2h + 2 pad, 3) float32, levels per pixel."""
    padded = around_sphere(picture, _PADDING_PX).astype(np.float32)
    smooth = cv2.GaussianBlur(padded, (0, 0), 0.7)
    return cv2.Sobel(smooth, -1, 1, 0, scale=1 / 8), cv2.Sobel(smooth, -1, 0, 1, scale=1 / 8)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("hwc,hwc->hw", a, b)
