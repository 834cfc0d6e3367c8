"""Bearings of the map's points: the family of the angle between measured and predicted rays."""

from collections.abc import Sequence

import numpy as np

from factors import BearingTerm, Term, tangent_basis
from gsba.bundle.families import Family
from gsba.bundle.point_observations import PointObservations
from gsba.camera.rig import RIG_R_FACE


class Bearings(Family):
    """Directions to the map's points on the sphere: no seam, no pole, no face. See
    `factors.bearing`."""

    name = "bearing"
    digest = ""
    observes_points = True

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """One bearing an observation, as noisy as on its face: a circle of pixels is an ellipse on
        the sphere."""
        return [
            BearingTerm(
                observed.frames,
                observed.points,
                observed.bearings_rig,
                observed.sigmas_rad,
                _face_roots(observed) if observed.sqrt_infos is None else observed.sqrt_infos,
                origins_rig=observed.origins_rig,
            )
        ]


def _face_roots(observed: PointObservations) -> np.ndarray:
    """Square-root information (O, 2, 2), 1/rad on `factors.tangent_basis`, of keypoints whose noise
    is equal along both axes of their face.

    At an angle a from the axis of a face of focal length f, a pixel subtends cos^2(a) / f away from
    the axis and cos(a) / f around it. `sigmas_rad` is the geometric mean of both.
    """
    bearings, axes = observed.bearings_rig, RIG_R_FACE[observed.faces, :, 2]
    cosines = np.einsum("oi,oi->o", bearings, axes)
    outward = cosines[:, None] * bearings - axes
    along = np.einsum("oij,oj->oi", tangent_basis(bearings), outward)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-12)[:, None]
    products = along[:, :, None] * along[:, None, :]
    root = np.sqrt(np.clip(cosines, 0.1, 1.0))[:, None, None]
    return (root * np.eye(2) + (1 / root - root) * products) / observed.sigmas_rad[:, None, None]
