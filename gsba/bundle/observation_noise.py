"""Noise of observations, in units of their own sigmas, by what their points leave of residuals."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from factors.compiled import kernel_and_part
from factors.kernel_parts import invert_symmetric, tangent_axes, times_symmetric
from gsba.bundle.tracks import map_runs
from gsba.disk import concatenated
from gsba.memory import release_mapped_files
from gsba.types import Keypoints, Landmarks, Tracks
from gsba.types.records import slices

_kernel, _part = kernel_and_part()


@_kernel
def standardized_residuals(
    first, last, starts, points, frames, poses, bearings, roots, origins, out
):
    """Residuals (O,) of the observations of points first to last - 1, all of the same spread.

    Args:
        starts (J + 1,): point j owns observations starts[j]:starts[j + 1].
        points (J, 3): world. frames (O,), poses (F, 4, 4): T_world_rig.
        bearings (O, 3): unit, rig frame.
        roots (O, 2, 2): square-root information on `factors.tangent_basis`.
        origins (O, 3): where rays start, rig frame; (0, 3) = the rig's centre.
        out (O,): written.
    """
    longest = 0
    for j in range(first, last):
        longest = max(longest, starts[j + 1] - starts[j])
    rows = np.empty((longest, 8))  # residual (2) and its Jacobian by the point (2 x 3)
    normal = np.empty(6)
    for j in range(first, last):
        _standardize(j, starts, points, frames, poses, bearings, roots, origins, rows, normal, out)


@_part
def _standardize(j, starts, points, frames, poses, bearings, roots, origins, rows, normal, out):
    """`standardized_residuals` of point j."""
    normal[:] = 0.0
    for o in range(starts[j], starts[j + 1]):
        row = rows[o - starts[j]]
        _by_point(o, points[j], poses[frames[o]], bearings, roots, origins, row)
        a0, a1, a2, b0, b1, b2 = row[2], row[3], row[4], row[5], row[6], row[7]
        normal[0] += a0 * a0 + b0 * b0
        normal[1] += a0 * a1 + b0 * b1
        normal[2] += a0 * a2 + b0 * b2
        normal[3] += a1 * a1 + b1 * b1
        normal[4] += a1 * a2 + b1 * b2
        normal[5] += a2 * a2 + b2 * b2
    covariance = invert_symmetric(normal, 0.0)  # as depth may be unknown
    for o in range(starts[j], starts[j + 1]):
        out[o] = _along(rows[o - starts[j]], covariance)


@_part
def _by_point(o, point, pose, bearings, roots, origins, row):
    """Whitened residual of observation o, and its Jacobian by the point: the angles are small."""
    x, y, z = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    dx = pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z
    dy = pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z
    dz = pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z
    if len(origins):
        dx, dy, dz = dx - origins[o, 0], dy - origins[o, 1], dz - origins[o, 2]
    u0, u1, u2, v0, v1, v2 = tangent_axes(bearings[o, 0], bearings[o, 1], bearings[o, 2])
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    for i in range(2):
        s, t = roots[o, i, 0], roots[o, i, 1]
        c0, c1, c2 = s * u0 + t * v0, s * u1 + t * v1, s * u2 + t * v2
        c0, c1, c2 = c0 / distance, c1 / distance, c2 / distance
        row[i] = c0 * dx + c1 * dy + c2 * dz
        for k in range(3):
            row[2 + 3 * i + k] = c0 * pose[k, 0] + c1 * pose[k, 1] + c2 * pose[k, 2]


@_part
def _product(row, i, k, covariance):
    """Rows i and k of a Jacobian, about the covariance of its point."""
    p, q, r = times_symmetric(covariance, row[2 + 3 * i], row[3 + 3 * i], row[4 + 3 * i])
    return p * row[2 + 3 * k] + q * row[3 + 3 * k] + r * row[4 + 3 * k]


@_part
def _along(row, covariance):
    """The residual in the direction in which its point leaves the most, over its spread there."""
    a, d = 1.0 - _product(row, 0, 0, covariance), 1.0 - _product(row, 1, 1, covariance)
    b = -_product(row, 0, 1, covariance)
    half = 0.5 * (a - d)
    radius = np.sqrt(half * half + b * b)
    if half >= 0:
        x, y = half + radius, b
    else:
        x, y = b, radius - half
    length = np.sqrt(x * x + y * y)
    x, y = (x / length, y / length) if length > 0 else (0.0, 1.0)
    left = 0.5 * (a + d) + radius
    return (x * row[0] + y * row[1]) / np.sqrt(max(left, 1e-3))


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
    u0, u1, u2, v0, v1, v2 = tangent_axes(mx, my, mz)
    s, t = u0 * x + u1 * y + u2 * z, v0 * x + v1 * y + v2 * z
    length = max(np.sqrt(s * s + t * t), _MIN_LENGTH)
    s, t = s / length, t / length
    root = np.sqrt(min(max(cosine, _MIN_COSINE), 1.0))
    more = 1.0 / root - root
    out[o, 0, 0] = (root + more * s * s) / sigmas[o]
    out[o, 0, 1] = out[o, 1, 0] = more * s * t / sigmas[o]
    out[o, 1, 1] = (root + more * t * t) / sigmas[o]


_AT_ONCE = 1 << 18  # keypoints whose noise is scaled together: 17 MB


def observation_noise(
    landmarks: Landmarks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
    num_threads: int,
    chosen: np.ndarray | slice = slice(None),
) -> float:
    """Noise in units of the features' sigmas: robust spread of residuals over its expectation, of
    chosen observations (O,), poses (F, 4, 4); it does not depend on the number of threads.

    The points are placed by least squares: under the robust loss of the adjustment they would lie
    closer to most of their observations than the noise allows. A residual e of noise sigma has the
    covariance sigma^2 (I - J (sum J^T J)^-1 J^T), J that of the observation by its point: nothing
    of it is left along the epipolar line where a point has two observations, nearly all where it
    has many. So each residual is taken along the direction in which the point leaves the most of
    it, over the square root of that eigenvalue: all observations then spread alike.
    """
    tracks, num = landmarks.tracks, len(landmarks.tracks)
    spread, poses = np.empty(num), np.ascontiguousarray(world_T_rigs)

    def work(points: slice, rows: slice, some: Tracks) -> None:
        spread[rows] = _residuals(landmarks.points_world[points], some, keypoints, poses)

    for _ in map_runs(work, tracks, num_threads):
        pass
    unknowns = 6 * len(world_T_rigs)
    # least share of residual dimensions
    redundancy = max(1 - unknowns / max(2 * num - 3 * tracks.num_points, 1), 0.1)
    kept = spread[chosen]
    np.abs(kept, out=kept)
    return float(1.4826 * np.median(kept, overwrite_input=True) / np.sqrt(redundancy))


def _residuals(
    points_world: np.ndarray, tracks: Tracks, keypoints: Keypoints, world_T_rigs: np.ndarray
) -> np.ndarray:
    """Residuals (O,) of the observations of points (J, 3), all of the same spread."""
    starts = np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))
    rows, spread = keypoints.rows(tracks), np.empty(len(tracks))
    origins = keypoints.origins_of(rows)
    origins = np.zeros((0, 3)) if origins is None else origins
    bearings = keypoints.bearings_rig.take(rows, axis=0)
    seen = bearings, np.ascontiguousarray(keypoints.roots(rows)), origins
    standardized_residuals(
        0, tracks.num_points, starts, points_world, tracks.frames, world_T_rigs, *seen, spread
    )
    return spread


def with_scaled_noise(
    keypoints: Keypoints, factors: np.ndarray, folder: Path | None = None
) -> Keypoints:
    """As `Keypoints.scaled_noise` by factors (N,), of keypoints that may be very many: a folder on
    the disk takes the noise; None = it is in memory."""
    if folder is None:
        return keypoints.scaled_noise(factors)
    infos = keypoints.sqrt_infos

    def scaled() -> Iterator[tuple[np.ndarray, ...]]:
        for some in slices(len(factors), _AT_ONCE):
            sigmas = keypoints.sigmas_rad[some] * factors[some]
            yield sigmas, *([] if infos is None else [infos[some] / factors[some, None, None]])
            release_mapped_files()

    sigmas, *roots = concatenated(scaled(), folder)
    return replace(keypoints, sigmas_rad=sigmas, sqrt_infos=roots[0] if roots else None)
