"""Bearings of the map's points: the family of the angle between measured and predicted rays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import BearingTerm, FaceCameras, ReprojectionTerm, Term
from gsba.bundle.families import Family, PointObservations
from gsba.bundle.observation_noise import face_roots
from gsba.camera.rig import RIG_R_FACE, CubeRig


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


@dataclass(frozen=True, slots=True)
class Reprojections(Family):
    """Pixels of the map's points on the faces that show them. See `factors.reprojection`."""

    name = "reprojection"
    digest = ""
    observes_points = True

    rig: CubeRig  # the faces

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """One pixel an observation, as noisy as the angle that it subtends."""
        rig, bearings, faces = self.rig, observed.bearings_rig, observed.faces
        cosines = np.einsum("oi,oi->o", bearings, RIG_R_FACE[faces, :, 2])
        num, pixels = len(RIG_R_FACE), observed.pixels
        if observed.origins_rig is not None:  # rays of lenses start elsewhere than faces show them
            pixels = rig.project(bearings, faces)
        cameras = FaceCameras(RIG_R_FACE, np.full(num, rig.focal), np.full((num, 2), rig.principal))
        return [
            ReprojectionTerm(
                observed.frames,
                observed.points,
                pixels,
                faces,
                cameras,
                observed.sigmas_rad * rig.focal / cosines**1.5,
                origins_rig=observed.origins_rig,
            )
        ]
