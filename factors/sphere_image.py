"""Grey panoramas sampled along bearings: cubic B-splines that know neither seam nor poles' edge.

Values and gradients come from one interpolant, so that an analytic Jacobian is exact. Prefilter
and kernel are those of Unser, "Splines: A Perfect Fit", IEEE Signal Processing Magazine 16(6),
1999.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import correlate1d, spline_filter1d

from factors._photometric_kernels import CODE_SCALE, CODE_ZERO, sample_many

PAD = 2  # coefficients beyond the border: the support of the spline
_REACH = 16  # rows beyond a pole after which the prefilter has forgotten the border, 0.27^16


@dataclass(frozen=True, slots=True)
class SphereImage:
    """Spline coefficients of one equirectangular grey image, two bytes each."""

    codes: np.ndarray  # (H + 2 PAD, 2 H + 2 PAD) int16, continued over seam and poles
    width: int  # pixels, 2 H

    @classmethod
    def of(cls, grey: np.ndarray) -> "SphereImage":
        """Prefilter an image (H, 2 H), grey values 0..255 of any type.

        Raises:
            ValueError: not twice as wide as high, an odd height, or values that are not finite.
        """
        image = np.asarray(grey, dtype=np.float32)
        _check(image)
        height, width = image.shape
        reach = min(_REACH, height)
        tall = _over_poles(image, reach)
        filtered = np.empty_like(tall)
        spline_filter1d(tall, axis=1, output=filtered, mode="grid-wrap")  # type: ignore[arg-type]
        spline_filter1d(filtered, axis=0, output=tall, mode="mirror")  # type: ignore[arg-type]
        rows = tall[reach - PAD : reach + height + PAD]
        wide = np.concatenate([rows[:, -PAD:], rows, rows[:, :PAD]], axis=1)
        steps = np.rint((wide - CODE_ZERO) * CODE_SCALE)
        return cls(np.clip(steps, -32768, 32767).astype(np.int16), width)

    @property
    def window(self) -> np.ndarray:
        """(4,) int32: first column and row, width and height of `codes` on the image."""
        return np.array([-PAD, -PAD, self.codes.shape[1], self.codes.shape[0]], dtype=np.int32)

    def sample(self, bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Grey values along bearings and how they change.

        Args:
            bearings: (..., 3) float64, rig frame, of any length but zero (there: NaN).

        Returns:
            values (...,) float64 and their gradients (..., 3) by the vector given; these are at
            right angles to it.
        """
        flat = np.ascontiguousarray(bearings, dtype=np.float64).reshape(-1, 3)
        values, gradients = np.empty(len(flat)), np.empty((len(flat), 3))
        sample_many(self.codes.ravel(), self.window, self.width, flat, values, gradients)
        shape = np.shape(bearings)
        return values.reshape(shape[:-1]), gradients.reshape(shape)


def halved(grey: np.ndarray) -> np.ndarray:
    """The next level of an image pyramid: (H, 2 H) to (H / 2, H) float32, low-passed.

    The filter [1 3 3 1] / 8 sits on the corners between pixels, so that bearings stay in place.
    """
    image = np.asarray(grey, dtype=np.float32)
    _check(image)
    if len(image) % 4:
        raise ValueError(f"an image of {len(image)} rows has no half: the rows must be fours")
    taps = np.array([1, 3, 3, 1], dtype=np.float32) / 8
    tall = correlate1d(_over_poles(image, PAD), taps, axis=0, origin=-1)[PAD:-PAD][::2]
    return correlate1d(tall, taps, axis=1, mode="wrap", origin=-1)[:, ::2]


def pixels_of(bearings: np.ndarray, width: int) -> np.ndarray:
    """Equirectangular pixels (..., 2), (u, v), corner origin, of vectors (..., 3), rig frame."""
    x, y, z = bearings[..., 0], bearings[..., 1], bearings[..., 2]
    per_radian = width / (2 * np.pi)
    u = per_radian * np.arctan2(x, z) + width / 2
    return np.stack([u, per_radian * np.arctan2(y, np.hypot(x, z)) + width / 4], axis=-1)


def _over_poles(image: np.ndarray, rows: int) -> np.ndarray:
    """Continue an image over both poles, where the sphere goes on half a turn further."""
    half = image.shape[1] // 2
    above = np.roll(image[:rows][::-1], half, axis=1)
    below = np.roll(image[-rows:][::-1], half, axis=1)
    return np.concatenate([above, image, below], axis=0)


def _check(image: np.ndarray) -> None:
    if image.ndim != 2 or image.shape[1] != 2 * image.shape[0] or image.shape[0] % 2:
        raise ValueError(f"a sphere image is (H, 2 H) with an even H, not {image.shape}")
    if not np.all(np.isfinite(image)):
        raise ValueError("the grey values must be finite")
