"""A panorama as a smooth function on the sphere: cubic B-spline through its pixels."""

from dataclasses import dataclass

import numpy as np

from factors.compiled import kernel_and_part

_POLE = np.sqrt(3.0) - 2.0  # pole of the cubic B-spline's inverse filter
_NUM_TERMS = 16  # terms of its geometric series: further ones are below float32's resolution

_kernel, _part = kernel_and_part(fastmath={"contract", "reassoc", "nsz"})


@_kernel
def filter_rows(image):
    """Inverse cubic B-spline filter along each row in place, rows being periodic."""
    num, length = image.shape
    pole = np.float32(_POLE)
    for r in range(num):
        row = image[r]
        start, power = np.float32(0.0), np.float32(1.0)
        for k in range(_NUM_TERMS):
            start += power * row[-k % length]
            power *= pole
        row[0] = np.float32(6.0) * start
        for k in range(1, length):
            row[k] = np.float32(6.0) * row[k] + pole * row[k - 1]
        end, power = np.float32(0.0), -pole
        for k in range(_NUM_TERMS):
            end += power * row[(length - 1 + k) % length]
            power *= pole
        row[length - 1] = end
        for k in range(length - 2, -1, -1):
            row[k] = pole * (row[k + 1] - row[k])


@_kernel
def filter_columns(image):
    """Inverse cubic B-spline filter along each column in place, columns being periodic."""
    length = len(image)
    pole = np.float32(_POLE)
    ends = np.zeros_like(image[0])
    power = np.float32(1.0)
    for k in range(_NUM_TERMS):
        ends += power * image[-k % length]
        power *= pole
    image[0] = np.float32(6.0) * ends
    for k in range(1, length):
        for c in range(image.shape[1]):
            image[k, c] = np.float32(6.0) * image[k, c] + pole * image[k - 1, c]
    ends[:] = 0.0
    power = -pole
    for k in range(_NUM_TERMS):
        ends += power * image[(length - 1 + k) % length]
        power *= pole
    image[length - 1] = ends
    for k in range(length - 2, -1, -1):
        for c in range(image.shape[1]):
            image[k, c] = pole * (image[k + 1, c] - image[k, c])


@_part
def erp_pixel(x, y, z, width, height):
    """Pixel (u, v) of a vector, u in [0, width]."""
    u = width * (np.arctan2(x, z) / (2 * np.pi) + 0.5)
    v = height * (0.5 + np.arctan2(y, np.sqrt(x * x + z * z)) / np.pi)
    return u, v


@_part
def spline_weights(t):
    """Cubic B-spline weights of the four samples around a position t in [0, 1) after the second."""
    s = np.float32(1.0) - t
    sixth = np.float32(1.0 / 6.0)
    w0, w3 = sixth * s * s * s, sixth * t * t * t
    w1 = np.float32(2.0 / 3.0) - t * t * (np.float32(1.0) - np.float32(0.5) * t)
    return w0, w1, np.float32(1.0) - w0 - w1 - w3, w3


@_part
def _slopes(t):
    """Derivatives of `spline_weights` by t."""
    s = np.float32(1.0) - t
    half = np.float32(0.5)
    d1 = t * (np.float32(1.5) * t - np.float32(2.0))
    return -half * s * s, d1, half * s * s - d1 - half * t * t, half * t * t


@_part
def tap(coefficients, row, column):
    """Coefficient at any row and column, continued across the seam and the poles."""
    height, width = coefficients.shape
    if row < 0:
        row, column = -1 - row, column + width // 2
    elif row >= height:
        row, column = 2 * height - 1 - row, column + width // 2
    return coefficients[row, column % width]


@_part
def sample_gradient(coefficients, u, v):
    """Value at pixel (u, v) and its derivatives by u and v."""
    u, v = u - 0.5, v - 0.5
    column, row = int(np.floor(u)), int(np.floor(v))
    t, s = np.float32(u - column), np.float32(v - row)
    a0, a1, a2, a3 = spline_weights(t)
    d0, d1, d2, d3 = _slopes(t)
    b0, b1, b2, b3 = spline_weights(s)
    e0, e1, e2, e3 = _slopes(s)
    value = by_u = by_v = np.float32(0.0)
    for k in range(4):
        b = b0 if k == 0 else (b1 if k == 1 else (b2 if k == 2 else b3))
        e = e0 if k == 0 else (e1 if k == 1 else (e2 if k == 2 else e3))
        r = row - 1 + k
        c0, c1 = tap(coefficients, r, column - 1), tap(coefficients, r, column)
        c2, c3 = tap(coefficients, r, column + 1), tap(coefficients, r, column + 2)
        across = a0 * c0 + a1 * c1 + a2 * c2 + a3 * c3
        value += b * across
        by_v += e * across
        by_u += b * (d0 * c0 + d1 * c1 + d2 * c2 + d3 * c3)
    return value, by_u, by_v


@_kernel
def sample_vectors(coefficients, vectors, values, gradients):
    """Values (N,) and gradients (N, 3) by the vector, at vectors (N, 3) of any length."""
    height, width = coefficients.shape
    for n in range(len(vectors)):
        x, y, z = vectors[n, 0], vectors[n, 1], vectors[n, 2]
        u, v = erp_pixel(x, y, z, width, height)
        value, by_u, by_v = sample_gradient(coefficients, u, v)
        flat2 = max(x * x + z * z, 1e-18 * y * y)  # at a pole any longitude will do
        flat, squared = np.sqrt(flat2), flat2 + y * y
        lon, lat = by_u * width / (2 * np.pi) / flat2, by_v * height / np.pi / squared
        values[n] = value
        gradients[n, 0] = lon * z - lat * y * x / flat
        gradients[n, 1] = lat * flat
        gradients[n, 2] = -lon * x - lat * y * z / flat


@dataclass(frozen=True, slots=True)
class SphereImage:
    """An equirectangular image that can be sampled at any bearing, with its gradient.

    The spline is periodic across the seam, and continues over a pole on the meridian opposite.
    """

    coefficients: np.ndarray  # (H, 2H) float32, of the cubic B-spline, not pixel values

    @classmethod
    def of(cls, grey: np.ndarray, smooth: bool = False) -> "SphereImage":
        """Fit the spline through all pixels of an equirectangular image (H, 2H) of any real type, H
        at least 2, or one that smooths them.

        Unser, "Splines: a perfect fit for signal and image processing", IEEE SPM 16(6), 1999.
        Smoothed, pixel values are the coefficients: that blurs by 0.58 pixels (standard deviation
        per axis) equally at all positions between pixels, and reduces noise. ValueError: another
        shape.
        """
        height, width = grey.shape
        if width != 2 * height or height < 2:
            raise ValueError(f"a panorama is (H, 2H), not {grey.shape}")
        rows = np.array(grey, dtype=np.float32, order="C")
        if smooth:
            return cls(rows)
        filter_rows(rows)
        # Two opposite meridians are one circle: down the first, and up the second.
        circles = np.concatenate([rows[:, :height], rows[::-1, height:]])
        filter_columns(circles)
        rows[:, :height], rows[:, height:] = circles[:height], circles[height:][::-1]
        return cls(rows)

    def sample(self, vectors_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (...) float64 in grey values in the directions of vectors (..., 3) float64, not
        zero, of any length, rig frame; and their gradients (..., 3) by the vector, across it."""
        vectors = np.asarray(vectors_rig, dtype=np.float64)
        flat = np.ascontiguousarray(vectors.reshape(-1, 3))
        values, gradients = np.empty(len(flat)), np.empty((len(flat), 3))
        sample_vectors(self.coefficients, flat, values, gradients)
        return values.reshape(vectors.shape[:-1]), gradients.reshape(vectors.shape)
