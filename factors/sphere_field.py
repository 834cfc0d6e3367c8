"""A smooth displacement field on the sphere: vector spherical harmonics, without rotations.

Residual errors of a 360-degree camera's calibration and stitching depend on direction. The field
is a sum of gradients and curls of real spherical harmonics from degree 1 on, orthonormal over the
sphere. The curls of degree 1 are left out: they are rotations, which poses already contain.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np

from factors.bearing import tangent_basis
from factors.compiled import kernel_and_part

_kernel, _part = kernel_and_part()


def num_harmonics(degree: int) -> int:
    """Number of coefficients of a field up to a degree."""
    return max(2 * degree * (degree + 2) - 3, 0)


def degree_of(num: int) -> int:
    """Degree of a field with `num` coefficients. ValueError: no degree has that many."""
    degree = 0
    while num_harmonics(degree) < num:
        degree += 1
    if num_harmonics(degree) != num:
        raise ValueError(f"no degree has {num} coefficients")
    return degree


def degrees_of(num: int) -> np.ndarray:
    """Degree (K,) of each of the first coefficients, from 1."""
    each = [np.full(3 if k == 1 else 4 * k + 2, k) for k in range(1, degree_of(num) + 1)]
    return np.concatenate([*each, np.zeros(0, int)]).astype(np.int64)


def harmonics(bearings: np.ndarray, degree: int) -> np.ndarray:
    """Tangent vectors (N, 3, K) float64 of each harmonic at unit bearings (N, 3), by degree,
    gradients before curls within each; orthonormal over the sphere. Solid harmonics by their
    Cartesian recurrences, which have no pole."""
    flat = np.ascontiguousarray(bearings, dtype=np.float64)
    out = np.zeros((len(flat), 3, num_harmonics(degree)))
    if degree:
        _fill(flat, _norms(degree), out)
    return out


@dataclass(frozen=True, slots=True)
class SphereField:
    """Smooth displacements of directions, in the rig frame."""

    coefficients: np.ndarray  # (K,) float64, radians, of `harmonics`; K = 0: no field

    @classmethod
    def none(cls) -> "SphereField":
        """The zero field."""
        return cls(np.zeros(0))

    def __bool__(self) -> bool:
        return bool(np.any(self.coefficients))

    @property
    def rms_rad(self) -> float:
        """Root mean square displacement over the sphere."""
        return float(np.sqrt(np.sum(self.coefficients**2) / (4 * np.pi)))

    def displacements(self, bearings: np.ndarray) -> np.ndarray:
        """Tangent vectors (..., 3), radians, at unit bearings (..., 3)."""
        flat = np.ascontiguousarray(bearings, dtype=np.float64).reshape(-1, 3)
        out = np.zeros_like(flat)
        degree = degree_of(len(self.coefficients))
        if degree:
            _sum_fields(flat, _norms(degree), self.coefficients, out)
        return out.reshape(np.shape(bearings))

    def corrected(self, bearings: np.ndarray) -> np.ndarray:
        """True directions of observed unit bearings (..., 3), along the field's arcs."""
        if not self:
            return bearings
        tangents = self.displacements(bearings)
        angles = np.linalg.norm(tangents, axis=-1, keepdims=True)
        return np.cos(angles) * bearings + np.sinc(angles / np.pi) * tangents

    def observed(self, directions: np.ndarray) -> np.ndarray:
        """Observed bearings (..., 3) of true unit directions (..., 3): the inverse of
        `corrected`."""
        if not self:
            return directions
        found = directions
        for _ in range(20):  # fixed-point steps: each reduces the error by the field's slope
            off = directions - self.corrected(found)
            found = found + off
            found = found / np.linalg.norm(found, axis=-1, keepdims=True)
            if np.abs(off).max(initial=0.0) < 1e-12:
                break
        return found

    def corrected_roots(self, bearings: np.ndarray, roots: np.ndarray) -> np.ndarray:
        """Square-root informations (N, 2, 2) on the tangent bases of the corrected bearings, of
        those on the tangent bases of the observed bearings (N, 3)."""
        if not self:
            return roots
        there = tangent_basis(self.corrected(bearings))
        return roots @ (tangent_basis(bearings) @ np.swapaxes(there, 1, 2))


def _norms(degree: int) -> np.ndarray:
    """Factors [l, m], (degree + 1, degree + 1), that normalise gradients."""
    out = np.zeros((degree + 1, degree + 1))
    for n in range(1, degree + 1):
        for m in range(n + 1):
            area = (2 * n + 1) / (4 * np.pi) * factorial(n - m) / factorial(n + m)
            out[n, m] = np.sqrt(area * (2 if m else 1) / (n * (n + 1)))
    return out


@_part
def _put(n, column, norm, value, gx, gy, gz, x, y, z, out):
    """Write a harmonic's gradient, the tangent part of the solid harmonic's, and its curl."""
    gx, gy, gz = (
        norm * (gx - n * value * x),
        norm * (gy - n * value * y),
        norm * (gz - n * value * z),
    )
    k = column if n == 1 else 2 * n * n - 5 + column  # behind those of lower degrees
    out[0, k], out[1, k], out[2, k] = gx, gy, gz
    if n > 1:
        k += 2 * n + 1
        out[0, k], out[1, k], out[2, k] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx


@_part
def _harmonics_at(x, y, z, norms, solid, out):
    """Write the harmonics (3, K) at one direction; solid (2, 3, 4) is scratch.

    solid[i, j]: value and gradient of the solid harmonic of cosines (i = 0) or sines (1), of
    degree l - 1, l and l + 1 (j).
    """
    degree = len(norms) - 1
    c, cx, cy, cz, s, sx, sy, sz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(degree + 1):
        solid[:] = 0.0
        solid[0, 1, 0], solid[0, 1, 1], solid[0, 1, 2], solid[0, 1, 3] = c, cx, cy, cz
        solid[1, 1, 0], solid[1, 1, 1], solid[1, 1, 2], solid[1, 1, 3] = s, sx, sy, sz
        for n in range(m, degree + 1):
            for i in range(2 if m else 1):
                before, at, after = solid[i, 0], solid[i, 1], solid[i, 2]
                if n:
                    column = 2 * m - 1 + i if m else 0
                    _put(n, column, norms[n, m], at[0], at[1], at[2], at[3], x, y, z, out)
                a, b, d = 2.0 * n + 1.0, float(n + m), 1.0 / (n - m + 1)
                after[0] = d * (a * z * at[0] - b * before[0])
                after[1] = d * (a * z * at[1] - b * (before[1] + 2 * x * before[0]))
                after[2] = d * (a * z * at[2] - b * (before[2] + 2 * y * before[0]))
                after[3] = d * (a * (z * at[3] + at[0]) - b * (before[3] + 2 * z * before[0]))
                for k in range(4):
                    before[k], at[k] = at[k], after[k]
        f = 2.0 * m + 1.0
        c, cx, cy, cz, s, sx, sy, sz = (
            f * (x * c - y * s), f * (c + x * cx - y * sx), f * (x * cy - s - y * sy),
            f * (x * cz - y * sz), f * (y * c + x * s), f * (y * cx + s + x * sx),
            f * (c + y * cy + x * sy), f * (y * cz + x * sz),
        )  # fmt: skip


@_kernel
def _fill(bearings, norms, out):
    """Harmonics (N, 3, K) at unit bearings (N, 3)."""
    solid = np.empty((2, 3, 4))
    for i in range(len(bearings)):
        x, y, z = bearings[i, 0], bearings[i, 1], bearings[i, 2]
        _harmonics_at(x, y, z, norms, solid, out[i])


@_kernel
def _sum_fields(bearings, norms, coefficients, out):
    """Displacements (N, 3) at unit bearings (N, 3)."""
    solid, each = np.empty((2, 3, 4)), np.empty((3, len(coefficients)))
    for i in range(len(bearings)):
        x, y, z = bearings[i, 0], bearings[i, 1], bearings[i, 2]
        _harmonics_at(x, y, z, norms, solid, each)
        for k in range(len(coefficients)):
            for j in range(3):
                out[i, j] += coefficients[k] * each[j, k]
