"""Surface normals around points, from affine parts of patch alignments.

A patch is a plane through a point. Its template's step (x, y) lies at the relative depth
1 + slopes @ (x, y); slopes of zero face the host. In another view, depth along the host's ray
appears as a shift: if the true slopes differ by d from those that projected the patch, the affine
part M of its alignment is u d^T, u the image of the host's ray in template steps. All sightings of
a template give d by least squares. A wrong slope also shifts the patch by its second-order
terms: always the same way along a floor or a wall, which bends maps.
"""

import numpy as np

from factors import tangent_basis

_AFFINE_SIGMA = 0.07  # noise of an alignment's affine part
_SLOPE_SIGMA = 0.7  # prior of surface slopes, tangents of their tilt
_MAX_TILT_TANGENT = 3.0  # tangent of a tilt beyond which a patch covers too little of its surface


def slopes_of(normals_rig: np.ndarray, origins: np.ndarray, spreads: np.ndarray) -> np.ndarray:
    """Relative depth (J, 2) that a step across each patch adds on its surface; 0 = unknown.

    Args:
        normals_rig: (J, 3) of the surfaces, any length, rig frame of the host; zero = unknown.
        origins: (J, 3) unit bearings of the points.
        spreads: (J, 3, 2) steps across them, radians.
    """
    facing = np.einsum("ji,ji->j", normals_rig, origins)
    across = np.einsum("ji,jic->jc", normals_rig, spreads)
    known = facing > 0
    slopes = -across / np.where(known, facing, 1.0)[:, None]
    steps = np.linalg.norm(spreads[:, :, 0], axis=1)
    steepness = np.linalg.norm(slopes, axis=1) / np.maximum(steps, 1e-300)
    slopes *= np.minimum(1.0, _MAX_TILT_TANGENT / np.maximum(steepness, _MAX_TILT_TANGENT))[:, None]
    return np.where(known[:, None], slopes, 0.0)


def shown_depths(
    spreads: np.ndarray, warps: np.ndarray, bearings: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shifts (N, 2) in template steps by which relative depth along the host's ray appears in each
    aligned sighting, and their products (N, 2) with the affine part.

    Args:
        spreads (N, 3, 2), warps (N, 6): of the sightings, see `factors.patches.Sightings`.
        bearings: (N, 3) where they were found, rig frame of the observing frame.
        rays: (N, 3) from the host to the template's point, in the observing frame, in units of its
            distance there.
    """
    axes = tangent_basis(bearings)
    shifts = np.linalg.solve(axes @ spreads, axes @ rays[:, :, None])[:, :, 0]
    affine = np.swapaxes(warps[:, 2:].reshape(-1, 2, 2), 1, 2)
    return shifts, np.einsum("oij,oi->oj", affine, shifts)


def normals(
    templates: np.ndarray,
    shifts: np.ndarray,
    products: np.ndarray,
    slopes: np.ndarray,
    origins: np.ndarray,
    spreads: np.ndarray,
) -> np.ndarray:
    """Normals (J, 3) of the surfaces, rig frames of the hosts, from their patches' alignments.

    Args:
        templates: (N,) template of each accepted sighting.
        shifts (N, 2), products (N, 2): see `shown_depths`.
        slopes: (J, 2) slopes by which the patches were projected.
        origins (J, 3), spreads (J, 3, 2): the patches in their hosts, before slopes.

    Returns:
        Normals of any length, zero where they are undetermined.
    """
    num = len(slopes)
    pulls = np.stack([np.bincount(templates, column, num) for column in products.T], axis=1)
    weights = np.bincount(templates, np.einsum("oi,oi->o", shifts, shifts), num)
    sizes = np.linalg.norm(spreads[:, :, 0], axis=1)
    prior = (_AFFINE_SIGMA / (_SLOPE_SIGMA * np.maximum(sizes, 1e-300))) ** 2
    found = slopes + (pulls - prior[:, None] * slopes) / (weights + prior)[:, None]
    gradients = np.einsum("jic,jc->ji", spreads, found) / sizes[:, None] ** 2
    return np.where((weights > prior)[:, None], origins - gradients, 0.0)
