"""Bearings of the map's points: the family of the angle between measured and predicted rays."""

from collections.abc import Sequence

import numpy as np

from factors import BearingTerm, Term
from gsba.bundle._bearing_kernels import face_roots
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
    """Square-root information (O, 2, 2), 1/rad on `tangent_basis`, of noise equal on face axes."""
    roots = np.empty((len(observed.faces), 2, 2))
    axes = np.ascontiguousarray(RIG_R_FACE[:, :, 2])
    face_roots(observed.bearings_rig, axes, observed.faces, observed.sigmas_rad, roots)
    return roots
