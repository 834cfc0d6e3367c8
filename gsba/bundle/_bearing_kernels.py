"""Compiled loop of bearings: the noise of keypoints on their faces, seen from the rig."""

import numpy as np

from factors.compiled import kernel_and_part

_kernel, _part = kernel_and_part()
_MIN_COSINE, _MIN_LENGTH = 0.1, 1e-12


@_kernel
def face_roots(bearings, axes, faces, sigmas, out):
    """Square-root information (O, 2, 2), 1/rad on `factors.tangent_basis`, of keypoints whose noise
    is equal along both axes of their face.

    At an angle a from the axis of a face of focal length f, a pixel subtends cos^2(a) / f away from
    the axis and cos(a) / f around it; sigmas are the geometric mean of both.

    Args:
        bearings (O, 3): unit, rig frame. axes (6, 3): of the faces. faces (O,): of keypoints.
        sigmas (O,): radians.
        out (O, 2, 2): written.
    """
    for o in range(len(faces)):
        _face_root(o, bearings, axes, faces, sigmas, out)


@_part
def _face_root(o, bearings, axes, faces, sigmas, out):
    """`face_roots` of keypoint o."""
    mx, my, mz = bearings[o, 0], bearings[o, 1], bearings[o, 2]
    ax, ay, az = axes[faces[o], 0], axes[faces[o], 1], axes[faces[o], 2]
    cosine = mx * ax + my * ay + mz * az
    x, y, z = cosine * mx - ax, cosine * my - ay, cosine * mz - az  # away from the axis
    sign = 1.0 if mz >= 0 else -1.0  # axes of factors.tangent_basis
    a = -1.0 / (sign + mz)
    b = mx * my * a
    s = (1.0 + sign * mx * mx * a) * x + sign * b * y - sign * mx * z
    t = b * x + (sign + my * my * a) * y - my * z
    length = max(np.sqrt(s * s + t * t), _MIN_LENGTH)
    s, t = s / length, t / length
    root = np.sqrt(min(max(cosine, _MIN_COSINE), 1.0))
    more = 1.0 / root - root
    out[o, 0, 0] = (root + more * s * s) / sigmas[o]
    out[o, 0, 1] = out[o, 1, 0] = more * s * t / sigmas[o]
    out[o, 1, 1] = (root + more * t * t) / sigmas[o]
