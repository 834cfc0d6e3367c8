"""Compiled residuals of single observations and sums over the observations of one landmark.

Poses are rows `(12,)` = `[world_R_rig row-major (9), rig_in_world (3)]`.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from factors.robust import rho_and_weight

BEARING, REPROJECTION = 0, 1
MIN_DEPTH = 1e-9  # of the unit direction: a point nearer to the face's plane counts as behind it
_EPS = 1e-300  # guards divisions by a squared norm


class Observations(NamedTuple):
    """All observations of a block, sorted by landmark, then frame."""

    offsets: np.ndarray  # (J + 1,) int64: landmark j owns rows offsets[j]:offsets[j + 1]
    frames: np.ndarray  # (O,) int32, row of the poses
    kinds: np.ndarray  # (O,) uint8, BEARING or REPROJECTION
    families: np.ndarray  # (O,) uint8, whose cost it counts to
    measurements: np.ndarray  # (O, 3): unit bearing, rig frame | u, v in pixels, row of cameras
    whiteners: np.ndarray  # (O, 3): [s00, s01, s11] of the upper triangular 2x2 sqrt information
    cameras: np.ndarray  # (C, 12): [rig_R_face row-major (9), focal, principal u, v in pixels]
    loss: int  # code of the robust loss
    loss_scale: float


@njit(cache=True, nogil=True)
def tangent_axes(mx, my, mz):
    """Two unit axes spanning the tangent plane at a unit vector.

    Branch on the sign of z only: Duff et al., Building an Orthonormal Basis, Revisited, 2017.
    """
    sign = 1.0 if mz >= 0 else -1.0
    a = -1.0 / (sign + mz)
    b = mx * my * a
    return (
        1.0 + sign * mx * mx * a, sign * b, -sign * mx,
        b, sign + my * my * a, -my,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _log_map(x, y, z):
    """Tangent vector at +z pointing to (x, y, z), its length the angle, and its Jacobian.

    r = f (x, y) with f = angle / hypot(x, y); dr = f I + k (x, y)(x, y)^T | -(x, y) / n^2.
    Both have a series where the angle is small, free of cancellation.
    """
    s2 = x * x + y * y
    n2 = s2 + z * z
    if n2 < _EPS:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if z > 0 and s2 < 0.01 * z * z:
        q = s2 / (z * z)
        f = 1.0 - q * (1 / 3 - q * (1 / 5 - q * (1 / 7 - q * (1 / 9 - q * (1 / 11 - q / 13)))))
        k = 2 / 3 - q * (4 / 5 - q * (6 / 7 - q * (8 / 9 - q * (10 / 11 - q * (12 / 13)))))
        f /= z
        k /= -z * z * z
    else:
        s = np.sqrt(s2)
        angle = np.arctan2(s, z)
        if s2 < 1e-24 * n2:  # opposite: every direction is as good, none has a derivative
            return angle, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        f = angle / s
        k = (z / n2 - f) / s2
    return f * x, f * y, f + k * x * x, k * x * y, -x / n2, k * x * y, f + k * y * y, -y / n2


@njit(cache=True, nogil=True)
def whitened_residual(obs, o, dx, dy, dz):
    """Whitened residual and Jacobian of observation o, its point being at d in the rig frame.

    Returns:
        valid, r0, r1, then the Jacobian d r / d d by rows (6 values). A point behind the face, or
        at the centre, is invalid: its Jacobian is zero and its residual a constant large one
        (2 focal in u and v as in GTSAM's projection factor; half a turn), so that it moves
        nothing and yet no step gains by sending points there.
    """
    measurement, whitener = obs.measurements[o], obs.whiteners[o]
    s00, s01, s11 = whitener[0], whitener[1], whitener[2]
    if obs.kinds[o] == BEARING:
        mx, my, mz = measurement[0], measurement[1], measurement[2]
        ax, ay, az, bx, by, bz = tangent_axes(mx, my, mz)
        if dx * dx + dy * dy + dz * dz < _EPS:
            return False, s00 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        x = ax * dx + ay * dy + az * dz
        y = bx * dx + by * dy + bz * dz
        z = mx * dx + my * dy + mz * dz
        r0, r1, j00, j01, j02, j10, j11, j12 = _log_map(x, y, z)
    else:
        camera = obs.cameras[int(measurement[2])]
        ax, bx, mx = camera[0], camera[1], camera[2]
        ay, by, my = camera[3], camera[4], camera[5]
        az, bz, mz = camera[6], camera[7], camera[8]
        x = ax * dx + ay * dy + az * dz
        y = bx * dx + by * dy + bz * dz
        z = mx * dx + my * dy + mz * dz
        if z * z <= MIN_DEPTH * MIN_DEPTH * (x * x + y * y) or z <= _EPS:
            r0 = r1 = 2.0 * camera[9]
            return False, s00 * r0 + s01 * r1, s11 * r1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        scale = camera[9] / z
        r0 = scale * x + camera[10] - measurement[0]
        r1 = scale * y + camera[11] - measurement[1]
        j00, j01, j02 = scale, 0.0, -scale * x / z
        j10, j11, j12 = 0.0, scale, -scale * y / z
    j00, j01, j02 = s00 * j00 + s01 * j10, s00 * j01 + s01 * j11, s00 * j02 + s01 * j12
    j10, j11, j12 = s11 * j10, s11 * j11, s11 * j12
    return (
        True,
        s00 * r0 + s01 * r1,
        s11 * r1,
        j00 * ax + j01 * bx + j02 * mx,
        j00 * ay + j01 * by + j02 * my,
        j00 * az + j01 * bz + j02 * mz,
        j10 * ax + j11 * bx + j12 * mx,
        j10 * ay + j11 * by + j12 * my,
        j10 * az + j11 * bz + j12 * mz,
    )


@njit(cache=True, nogil=True)
def rig_vector(pose, point):
    """Components of a world point seen from the rig, in the rig frame: world_R_rig^T (X - t)."""
    x, y, z = point[0] - pose[9], point[1] - pose[10], point[2] - pose[11]
    return (
        pose[0] * x + pose[3] * y + pose[6] * z,
        pose[1] * x + pose[4] * y + pose[7] * z,
        pose[2] * x + pose[5] * y + pose[8] * z,
    )


@njit(cache=True, nogil=True)
def invert_symmetric(v):
    """Inverse (6 values 00 01 02 11 12 22) of a damped symmetric 3x3 given the same way.

    A share of 1e-9 of the trace is added, so a direction that no observation constrains (one
    ray, no parallax) stays finite and moves no pose.
    """
    eps = 1e-9 * (v[0] + v[3] + v[5]) + 1e-200
    a, b, c, d, e, f = v[0] + eps, v[1], v[2], v[3] + eps, v[4], v[5] + eps
    l00 = np.sqrt(a)
    l10, l20 = b / l00, c / l00
    l11 = np.sqrt(max(d - l10 * l10, eps))
    l21 = (e - l10 * l20) / l11
    l22 = np.sqrt(max(f - l20 * l20 - l21 * l21, eps))
    i00, i11, i22 = 1 / l00, 1 / l11, 1 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    return (
        i00 * i00 + i10 * i10 + i20 * i20, i10 * i11 + i20 * i21, i20 * i22,
        i11 * i11 + i21 * i21, i21 * i22, i22 * i22,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def times_symmetric(v, x, y, z):
    """Product of a symmetric 3x3 (6 values) with a vector."""
    return (
        v[0] * x + v[1] * y + v[2] * z,
        v[1] * x + v[3] * y + v[4] * z,
        v[2] * x + v[4] * y + v[5] * z,
    )


@njit(cache=True, nogil=True)
def add_point_hessian(normal, pose, a0, a1, a2, b0, b1, b2, w):
    """Add w (d r / d X)^T (d r / d X) to normal[:6]; d r / d X = (d r / d d) world_R_rig^T."""
    p0 = a0 * pose[0] + a1 * pose[1] + a2 * pose[2]
    p1 = a0 * pose[3] + a1 * pose[4] + a2 * pose[5]
    p2 = a0 * pose[6] + a1 * pose[7] + a2 * pose[8]
    q0 = b0 * pose[0] + b1 * pose[1] + b2 * pose[2]
    q1 = b0 * pose[3] + b1 * pose[4] + b2 * pose[5]
    q2 = b0 * pose[6] + b1 * pose[7] + b2 * pose[8]
    normal[0] += w * (p0 * p0 + q0 * q0)
    normal[1] += w * (p0 * p1 + q0 * q1)
    normal[2] += w * (p0 * p2 + q0 * q2)
    normal[3] += w * (p1 * p1 + q1 * q1)
    normal[4] += w * (p1 * p2 + q1 * q2)
    normal[5] += w * (p2 * p2 + q2 * q2)


@njit(cache=True, nogil=True)
def point_normal_equations(obs, j, point, poses, out):
    """Cost of landmark j at `point`; its Hessian (6) and gradient (3) go into `out (9,)`."""
    out[:] = 0.0
    cost = 0.0
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        pose = poses[obs.frames[o]]
        dx, dy, dz = rig_vector(pose, point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = whitened_residual(obs, o, dx, dy, dz)
        rho, w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)
        cost += rho
        if not valid:
            continue
        add_point_hessian(out, pose, a0, a1, a2, b0, b1, b2, w)
        for c in range(3):
            p = a0 * pose[3 * c] + a1 * pose[3 * c + 1] + a2 * pose[3 * c + 2]
            q = b0 * pose[3 * c] + b1 * pose[3 * c + 1] + b2 * pose[3 * c + 2]
            out[6 + c] += w * (p * r0 + q * r1)
    return cost
