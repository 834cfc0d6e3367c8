"""Raw fisheyes as parts of one panorama: projection of rig directions into their pictures. After
recalibration a direction of a panorama is a pixel that has another direction."""

from dataclasses import replace

import numpy as np

from factors.bearing import tangent_basis
from gsba.camera.projections import FisheyeProjection
from gsba.types import Fisheye

Pair = tuple[Fisheye, Fisheye]  # front, back
Rig = tuple[Fisheye, ...]  # two lenses or more, the front one first

PARAMETERS = 10  # of a lens: relative focal length, principal point (2) in units of the focal
# length, radial terms (4), rotation (3) in the rig


def rotation_of(lens: Fisheye) -> np.ndarray:
    """rig_R_lens (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(lens.rotation).as_matrix()


def lens_names(num: int) -> tuple[str, ...]:
    """Names of L lenses in files."""
    return ("front", "back") if num == 2 else tuple(f"lens{lens}" for lens in range(num))


def optical_axes(rig: Rig) -> np.ndarray:
    """Directions (L, 3), rig frame, by whose nearest one a lens is said to face a direction.

    Of a pair these are z and -z of the rig, between which the seam lies; of more lenses these are
    their axes as calibrated.
    """
    if len(rig) == 2:
        return np.array([[0.0, 0, 1], [0, 0, -1]])
    return np.array([rotation_of(lens)[:, 2] for lens in rig])


def facing(directions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Lens (...,) int64 that faces directions (..., 3): the one of the nearest axis of (L, 3)."""
    return np.argmax(directions @ axes.T, axis=-1)


def projection_of(lens: Fisheye) -> FisheyeProjection:
    """The projection of a lens, without its place in the rig."""
    return FisheyeProjection(lens.width, lens.height, lens.focal, lens.principal, lens.radial)


def project(lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    """Pixels (..., 2), corner origin, of vectors (..., 3) in the rig frame."""
    return projection_of(lens).project(directions @ rotation_of(lens))


def unproject(lens: Fisheye, pixels: np.ndarray) -> np.ndarray:
    """Unit directions (..., 3) in the rig frame of pixels (..., 2), corner origin."""
    return projection_of(lens).unproject(pixels) @ rotation_of(lens).T


def by_move(lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    """Jacobian (N, 2, 2) of pixels by moves of unit directions (N, 3), rig frame, on their
    `tangent_basis`."""
    rig_R_lens = rotation_of(lens)
    by_local, _ = projection_of(lens).jacobians(directions @ rig_R_lens)
    return by_local @ rig_R_lens.T @ np.swapaxes(tangent_basis(directions), 1, 2)


def by_parameters(lens: Fisheye, directions: np.ndarray) -> np.ndarray:
    """Jacobians (N, 3, PARAMETERS) of the directions of fixed pixels, (N, 3) unit, rig frame, by
    the lens's parameters."""
    _, by_own = projection_of(lens).jacobians(directions @ rotation_of(lens))
    basis = tangent_basis(directions)  # (N, 2, 3) float64: a unit direction moves on it only
    moves = -np.linalg.solve(by_move(lens, directions), by_own)
    out = np.zeros((len(directions), 3, 3))
    x, y, z = directions.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return np.concatenate([np.swapaxes(basis, 1, 2) @ moves, -out], axis=2)


def changed(lens: Fisheye, step: np.ndarray) -> Fisheye:
    """A lens after a step (PARAMETERS,) in the parameters of `by_parameters`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(step[7:]) * Rotation.from_rotvec(lens.rotation)
    own = projection_of(lens).stepped(step[:7])
    k1, k2, k3, k4 = own.radial
    bent = replace(lens, focal=own.focal, principal=own.principal, radial=(k1, k2, k3, k4))
    return replace(bent, rotation=three(turn.as_rotvec()))


def turned(rig: Rig, old_R_new: np.ndarray) -> Rig:
    """The lenses in a rig whose axes are rotated by old_R_new (3, 3) against the old ones."""
    from scipy.spatial.transform import Rotation

    turns = [Rotation.from_matrix(old_R_new.T @ rotation_of(lens)).as_rotvec() for lens in rig]
    return tuple(replace(lens, rotation=three(t)) for lens, t in zip(rig, turns, strict=True))


def difference(lens: Fisheye, before: Fisheye) -> np.ndarray:
    """The step (PARAMETERS,) by which `changed` turns lens `before` into `lens`."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(lens.rotation) * Rotation.from_rotvec(before.rotation).inv()
    return np.array([*projection_of(lens).step_from(projection_of(before)), *turn.as_rotvec()])


def pixels_of(
    rig: Rig, directions: np.ndarray, lens: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Lens (...,) that faces directions (..., 3), or a given one of each, and their pixels (..., 2)
    in it."""
    lens = facing(directions, optical_axes(rig)) if lens is None else lens
    pixels = project(rig[0], directions)
    for number, other in enumerate(rig[1:], 1):
        pixels = np.where(lens[..., None] == number, project(other, directions), pixels)
    return lens, pixels


def recalibrated(
    directions: np.ndarray, before: Rig, after: Rig, lens: np.ndarray | None = None
) -> np.ndarray:
    """Directions of pixels by lenses `after`, given their directions (N, 3) by lenses `before`;
    lens: (N,) int, of each direction, None = that which faces it."""
    out = np.empty_like(directions)
    lens = facing(directions, optical_axes(before)) if lens is None else lens
    for number, (old, new) in enumerate(zip(before, after, strict=True)):
        part = lens == number
        out[part] = unproject(new, project(old, directions[part]))
    return out


def three(vector: np.ndarray) -> tuple[float, float, float]:
    """A vector (3,) as a `Fisheye` has it."""
    x, y, z = (float(value) for value in vector)
    return x, y, z
