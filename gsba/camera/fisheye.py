"""Two raw fisheyes as parts of one panorama: projection of rig directions into their pictures.

The lens that faces a direction sees it, as in `gsba.camera.lens`: the front one ahead of the rig,
the back one behind. Lenses may be recalibrated after panoramas were cut by them: then a direction
of a panorama is one pixel of a fisheye, which has another direction by the new calibration.
"""

from dataclasses import replace

import numpy as np

from gsba.types import Fisheye

Pair = tuple[Fisheye, Fisheye]  # front, back

PARAMETERS = 10  # of a lens: relative focal length, principal point (2) in units of the focal
# length, radial terms (4), rotation (3) in the rig
_NUM_NEWTON_STEPS = 8  # enough for angles to converge in double precision


def rotation_of(lens: Fisheye) -> np.ndarray:
    """rig_R_lens (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(lens.rotation).as_matrix()


def project(lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    """Pixels (..., 2), corner origin, of vectors (..., 3) in the rig frame."""
    local = directions @ rotation_of(lens)
    across = np.hypot(local[..., 0], local[..., 1])
    radii = lens.focal * _distorted_radii(lens, np.arctan2(across, local[..., 2]))[0]
    away = local[..., :2] / np.maximum(across, 1e-300)[..., None]
    return np.asarray(lens.principal) + radii[..., None] * away


def unproject(lens: Fisheye, pixels: np.ndarray) -> np.ndarray:
    """Unit directions (..., 3) in the rig frame of pixels (..., 2), corner origin."""
    away = (pixels - np.asarray(lens.principal)) / lens.focal
    radii = np.hypot(away[..., 0], away[..., 1])
    angles = radii.copy()
    for _ in range(_NUM_NEWTON_STEPS):
        bent, slope = _distorted_radii(lens, angles)
        angles = np.clip(angles - (bent - radii) / np.maximum(slope, 0.1), 0, np.pi)
    across = (np.sin(angles) / np.maximum(radii, 1e-300))[..., None] * away
    return np.concatenate([across, np.cos(angles)[..., None]], axis=-1) @ rotation_of(lens).T


def by_parameters(lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    """Jacobians (N, 3, PARAMETERS) of the directions of fixed pixels by the lens's parameters.

    Args:
        lens: its current parameters.
        directions: (N, 3) unit, rig frame, of the pixels.
    """
    turn = rotation_of(lens)
    local = directions @ turn
    across = np.hypot(local[:, 0], local[:, 1])
    angles = np.arctan2(across, local[:, 2])
    bent, slope = _distorted_radii(lens, angles)
    away = local[:, :2] / np.maximum(across, 1e-300)[:, None]
    beside = np.stack([-away[:, 1], away[:, 0]], axis=1)
    powers = angles[:, None] ** np.array([3, 5, 7, 9])
    by_angle = np.concatenate([-bent[:, None], -away, -powers], axis=1) / slope[:, None]
    around = np.zeros_like(by_angle)  # sine of the angle times the derivative by a rotation about
    # the axis
    shrunk = np.divide(across, bent, out=np.ones_like(bent), where=bent > 1e-9)
    around[:, 1:3] = -beside * shrunk[:, None]
    outwards = np.concatenate([np.cos(angles)[:, None] * away, -across[:, None]], axis=1)
    sideways = np.concatenate([beside, np.zeros((len(beside), 1))], axis=1)
    moved = outwards[:, :, None] * by_angle[:, None] + sideways[:, :, None] * around[:, None]
    return np.concatenate([np.einsum("ij,njk->nik", turn, moved), -_cross(directions)], axis=2)


def changed(lens: Fisheye, step: np.ndarray) -> Fisheye:
    """A lens after a step (PARAMETERS,) in the parameters of `by_parameters`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(step[7:]) * Rotation.from_rotvec(lens.rotation)
    x, y = np.asarray(lens.principal) + lens.focal * step[1:3]
    k1, k2, k3, k4 = np.asarray(lens.radial) + step[3:7]
    bent = replace(
        lens,
        focal=float(lens.focal * np.exp(step[0])),
        principal=(float(x), float(y)),
        radial=(float(k1), float(k2), float(k3), float(k4)),
    )
    return _with_rotation(bent, turn.as_rotvec())


def turned(pair: Pair, old_R_new: np.ndarray) -> Pair:
    """Both lenses in a rig whose axes are rotated by old_R_new (3, 3) against the old ones."""
    from scipy.spatial.transform import Rotation

    front, back = (
        Rotation.from_matrix(old_R_new.T @ rotation_of(lens)).as_rotvec() for lens in pair
    )
    return _with_rotation(pair[0], front), _with_rotation(pair[1], back)


def difference(lens: Fisheye, before: Fisheye) -> np.ndarray:
    """The step (PARAMETERS,) by which `changed` turns lens `before` into `lens`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(lens.rotation) * Rotation.from_rotvec(before.rotation).inv()
    away = (np.asarray(lens.principal) - before.principal) / before.focal
    radial = np.asarray(lens.radial) - before.radial
    return np.array([np.log(lens.focal / before.focal), *away, *radial, *turn.as_rotvec()])


def pixels_of(
    pair: Pair, directions: np.ndarray, behind: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Lens (...,), 0 or 1, that faces directions (..., 3), and their pixels (..., 2) in it.

    Args:
        behind: (...,) bool, directions to project by the back lens; None = those that it faces.
    """
    lens = (directions[..., 2] < 0 if behind is None else behind).astype(int)
    both = np.stack([project(one, directions) for one in pair])
    return lens, np.where(lens[..., None] == 0, both[0], both[1])


def recalibrated(
    directions: np.ndarray, before: Pair, after: Pair, behind: np.ndarray | None = None
) -> np.ndarray:
    """Directions of pixels by lenses `after`, given their directions (N, 3) by lenses `before`.

    Args:
        behind: (N,) bool, directions of the back lens; None = those that it faces.
    """
    out = np.empty_like(directions)
    behind = directions[:, 2] < 0 if behind is None else behind
    for part, old, new in zip((~behind, behind), before, after, strict=True):
        out[part] = unproject(new, project(old, directions[part]))
    return out


def _with_rotation(lens: Fisheye, rotation: np.ndarray) -> Fisheye:
    a, b, c = (float(v) for v in rotation)
    return replace(lens, rotation=(a, b, c))


def _distorted_radii(lens: Fisheye, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the principal point in focal lengths, and its derivative, at angles (rad)."""
    squares = angles * angles
    bent, slope = np.zeros_like(angles), np.zeros_like(angles)
    for power, k in zip((9, 7, 5, 3, 1), (*lens.radial[::-1], 1.0), strict=True):
        bent, slope = bent * squares + k, slope * squares + power * k
    return bent * angles, slope


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices (N, 3, 3) whose product with another vector is the cross product."""
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out
