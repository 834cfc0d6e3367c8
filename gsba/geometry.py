"""Closed-form geometry: equirectangular pixels, rotations, poses, Sim(3)."""

import numpy as np

from gsba.log import GsbaError

_LEAST_ALIKE = 1e-6  # correlation of positions: below, the scale that carries them vanishes


class NoSimilarityError(GsbaError):
    """No positive scale carries one set of positions onto the other."""


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


def rotation_from_quaternion(wxyz: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), wxyz."""
    w, x, y, z = np.moveaxis(np.asarray(wxyz, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4), wxyz with w >= 0, of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    xyzw = Rotation.from_matrix(flat).as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]].reshape((*np.shape(rotations)[:-2], 4))


def rotation_angle(rotations: np.ndarray) -> np.ndarray:
    """Angle (...,) in radians of rotation matrices (..., 3, 3); accurate near 0 and pi."""
    r = np.asarray(rotations)
    axis = np.stack(
        [
            r[..., 2, 1] - r[..., 1, 2],
            r[..., 0, 2] - r[..., 2, 0],
            r[..., 1, 0] - r[..., 0, 1],
        ],
        axis=-1,
    )
    return np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(r, axis1=-2, axis2=-1) - 1)


def pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Homogeneous poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    out = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1
    return out


def inverse(a_T_b: np.ndarray) -> np.ndarray:
    """b_T_a of rigid poses (..., 4, 4)."""
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return pose(b_R_a, -np.einsum("...ij,...j->...i", b_R_a, a_T_b[..., :3, 3]))


def angular_errors(
    world_T_rigs: np.ndarray, points_world: np.ndarray, bearings_rig: np.ndarray
) -> np.ndarray:
    """Angles (O,) in radians between observed bearings and the directions to their points.

    Args:
        world_T_rigs: (O, 4, 4) pose of each observation's frame.
        points_world: (O, 3) point of each observation.
        bearings_rig: (O, 3) unit, rig frame.
    """
    rays = np.einsum("oij,oj->oi", world_T_rigs[:, :3, :3], bearings_rig)
    offsets = points_world - world_T_rigs[:, :3, 3]
    across = np.linalg.norm(np.cross(rays, offsets), axis=1)
    return np.arctan2(across, np.einsum("oi,oi->o", rays, offsets))


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Least-squares Sim(3) with target = scale * rotation @ source + translation.

    Args:
        source, target: (N, 3) float64, N >= 3, not all on one point.

    Returns:
        scale, rotation (3, 3), translation (3,).

    Raises:
        NoSimilarityError: the targets are all on one point, or not where any turn has the sources.
    """
    s, t = source - source.mean(axis=0), target - target.mean(axis=0)
    return turned_similarity(source, target, _turn(t.T @ s / len(s)))


def turned_similarity(
    source: np.ndarray, target: np.ndarray, rotation: np.ndarray, least_alike: float = _LEAST_ALIKE
) -> tuple[float, np.ndarray, np.ndarray]:
    """The similarity with a given rotation, scale and translation being least squares.

    Every similarity of gsba ends here: an inverted or vanishing world is none.

    Args:
        source, target: (N, 3) float64, N >= 1; sources on one point leave the scale at 1.
        rotation: (3, 3).
        least_alike: correlation of both, once turned, from 0 to 1, that there must be.

    Returns:
        scale > 0, rotation, translation (3,).

    Raises:
        NoSimilarityError: positions correlate less, so that their scale would be nothing's.
    """
    turned = source @ rotation.T
    s, t = turned - turned.mean(axis=0), target - target.mean(axis=0)
    spread, across, wanted = (float(np.sum(a * b)) for a, b in ((s, s), (s, t), (t, t)))
    if spread <= 1e-24 * float(np.sum(source * source)):  # on one point, but for rounding
        scale = 1.0
    elif across > least_alike * np.sqrt(spread * wanted) > 0:
        scale = across / spread
    else:
        raise NoSimilarityError(
            "no positive scale carries one set of positions onto the other: they have nothing in "
            "common"
        )
    return scale, rotation, target.mean(axis=0) - scale * turned.mean(axis=0)


def _turn(covariance: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) nearest to a matrix (3, 3) in the sense of Umeyama, PAMI 13(4), 1991."""
    u, _, vt = np.linalg.svd(covariance)
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt


def furthest(positions: np.ndarray) -> tuple[int, float]:
    """Row of the position (N, 3) that is furthest from the first, and its distance."""
    distances = np.linalg.norm(positions - positions[0], axis=1)
    far = int(np.argmax(distances))
    return far, float(distances[far])


def carried(poses: np.ndarray, scale: float, new_T_old: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) under the similarity scale * R @ x + t, R and t of new_T_old (4, 4)."""
    rotation, translation = new_T_old[:3, :3], new_T_old[:3, 3]
    positions = scale * poses[..., :3, 3] @ rotation.T + translation
    return pose(rotation @ poses[..., :3, :3], positions)


def pose_similarity(
    source_T_rigs: np.ndarray, target_T_rigs: np.ndarray, least_alike: float = _LEAST_ALIKE
) -> tuple[float, np.ndarray, np.ndarray]:
    """Sim(3) that carries one set of poses onto another of the same rigs.

    The rotation is the chordal mean over orientations, so that a straight path will do; scale and
    translation are least squares over positions; a rig that never moves leaves the scale at 1.

    Args:
        source_T_rigs, target_T_rigs: (N, 4, 4) poses of the same rigs in two worlds.
        least_alike: see `turned_similarity`.

    Returns:
        scale, rotation (3, 3), translation (3,): target = scale * rotation @ source + translation.

    Raises:
        NoSimilarityError: the rigs are not where the targets have them, at no positive scale.
    """
    between = np.einsum("nij,nkj->ik", target_T_rigs[:, :3, :3], source_T_rigs[:, :3, :3])
    source, target = source_T_rigs[:, :3, 3], target_T_rigs[:, :3, 3]
    return turned_similarity(source, target, _turn(between), least_alike)


def adjoint(a_T_b: np.ndarray) -> np.ndarray:
    """Adjoints (N, 6, 6) of poses (N, 4, 4): tangents of b in a."""
    rotation, (x, y, z) = a_T_b[:, :3, :3], a_T_b[:, :3, 3].T
    zero = np.zeros_like(x)
    skew = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    out = np.zeros((len(a_T_b), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = rotation
    out[:, 3:, :3] = skew @ rotation
    return out


def step_covariances(
    world_T_rigs: np.ndarray, covariances: np.ndarray, neighbours: np.ndarray
) -> np.ndarray:
    """Covariances (F - 1, 6, 6) of the steps f_T_next, perturbed on the right.

    Args:
        world_T_rigs: (F, 4, 4).
        covariances: (F, 6, 6) of their tangents [rotation rad, translation].
        neighbours: (F - 1, 6, 6) E[x_f x_(f+1)^T].
    """
    before = -adjoint(inverse(world_T_rigs[1:]) @ world_T_rigs[:-1])
    shared = before @ neighbours
    own = covariances[1:] + before @ covariances[:-1] @ np.swapaxes(before, 1, 2)
    return own + shared + np.swapaxes(shared, 1, 2)
