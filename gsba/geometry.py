"""Closed-form geometry: rotations, poses, steps between them, angles of rays."""

import numpy as np

CV_R_GL = np.diag([1.0, -1, -1])  # axes of an OpenGL camera in ours: x right, y down, z forward


def local_origin(positions: np.ndarray) -> np.ndarray | None:
    """Origin (3,) near positions (N, 3) that are too far from 0 for float32; None for others.

    It is rounded to a power of ten above the extent.
    """
    finite = positions[np.isfinite(positions).all(axis=1)]
    if not len(finite):
        return None
    middle, extent = np.median(finite, axis=0), float(np.ptp(finite, axis=0).max())
    # float32 keeps 1e-6 of the extent there
    if not (extent > 0 and np.abs(middle).max() > 10.0 * extent):
        return None
    return np.round(middle, -int(np.ceil(np.log10(extent))))


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


def relative_steps(world_T_rigs: np.ndarray) -> np.ndarray:
    """Poses (F - 1, 4, 4) of each rig but the first in the frame of the one before."""
    return inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]


def moved_to(world_T_rigs: np.ndarray, origins_rig: np.ndarray | None) -> np.ndarray:
    """Poses (O, 4, 4) moved to the rays' origins (O, 3), rig frame; None = not moved."""
    if origins_rig is None:
        return world_T_rigs
    moved = world_T_rigs.copy()
    moved[:, :3, 3] += np.einsum("oij,oj->oi", world_T_rigs[:, :3, :3], origins_rig)
    return moved


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


def nearest_rotation(matrices: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the sense of Umeyama, PAMI 13(4),
    1991."""
    u, _, vt = np.linalg.svd(matrices)
    u[..., 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return u @ vt


def as_rotations(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotations nearest to finite matrices (..., 3, 3), and bool (...,): False where a matrix
    is none, by more than a thousandth in an entry."""
    nearest = nearest_rotation(matrices)
    return nearest, np.abs(nearest - matrices).max(axis=(-2, -1)) <= 1e-3


def median_direction(directions: np.ndarray) -> np.ndarray:
    """Unit vector (3,) with the least summed distance to unit vectors (N, 3) (Weiszfeld)."""
    median = directions.mean(axis=0)
    for _ in range(50):
        distance = np.linalg.norm(directions - median, axis=1)
        weights = 1 / np.maximum(distance, 1e-6)
        median = weights @ directions / weights.sum()
    length = np.linalg.norm(median)
    return median / length if length > 1e-9 else np.array([0.0, -1.0, 0.0])


def extent_of(positions: np.ndarray) -> float:
    """Diagonal of the box around positions (N, 3)."""
    return float(np.linalg.norm(np.ptp(positions, axis=0)))


def standing_length(lengths: np.ndarray) -> float:
    """A tenth of the length that nine tenths of the steps (N,) have at most, so that a few false
    ones do not count: shorter ones are of a camera that stands, and mere noise."""
    return 0.1 * float(np.quantile(lengths, 0.9, method="lower")) if len(lengths) else 0.0


def typical_length(lengths: np.ndarray) -> float:
    """Median of the lengths (N,) of steps in which the camera does not stand; 1 if it never
    moves."""
    walked = lengths[lengths > standing_length(lengths)]
    return float(np.median(walked)) if len(walked) else 1.0


def standing_places(centres: np.ndarray, walked: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Place (F,) int64, from 0, of each frame's centre (F, 3): consecutive frames in which the
    camera stands (`standing_length`) are at one place, as views from there differ by noise. Steps
    `walked (F - 1,)` bool tell how far it moves where it does not."""
    least = standing_length(np.linalg.norm(np.diff(centres, axis=0), axis=1)[walked])
    places, first = np.zeros(len(centres), np.int64), 0
    for f in range(1, len(centres)):
        moved = np.linalg.norm(centres[f] - centres[first]) > least
        first = f if moved else first
        places[f] = places[f - 1] + moved
    return places


def frames_beside(breaks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (F,) int64 before and after each one; across breaks (F - 1,) bool, and at both ends,
    it is the frame itself."""
    num, pauses = len(breaks) + 1, np.flatnonzero(breaks)
    before, after = np.arange(num) - 1, np.arange(num) + 1
    first, last = np.append(pauses + 1, 0), np.append(pauses, num - 1)
    before[first], after[last] = first, last
    return before, after


def furthest(positions: np.ndarray) -> tuple[int, float]:
    """Row of the position, of (N, 3), that is furthest from the first, and its distance."""
    distances = np.linalg.norm(positions - positions[0], axis=1)
    far = int(np.argmax(distances))
    return far, float(distances[far])


def adjoint(a_T_b: np.ndarray) -> np.ndarray:
    """Adjoints (N, 6, 6) of poses (N, 4, 4): they map tangents at b to tangents at a."""
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
        world_T_rigs: (F, 4, 4) poses.
        covariances: (F, 6, 6) of the poses' tangents x_f: [rotation rad, translation].
        neighbours: (F - 1, 6, 6) cross-covariances E[x_f x_(f+1)^T].
    """
    before = -adjoint(inverse(world_T_rigs[1:]) @ world_T_rigs[:-1])
    shared = before @ neighbours
    own = covariances[1:] + before @ covariances[:-1] @ np.swapaxes(before, 1, 2)
    return own + shared + np.swapaxes(shared, 1, 2)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) scaled to length one; 0 stays 0."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(lengths, 1e-300)


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (...,) in radians between vectors (..., 3); accurate near 0 and pi."""
    across = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.arctan2(across, np.sum(a * b, axis=-1))
