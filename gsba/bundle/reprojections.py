"""Reprojections of the map's points: the family of pixels on cube faces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors import FaceCameras, ReprojectionTerm, Term
from gsba.bundle.families import Family
from gsba.bundle.point_observations import PointObservations
from gsba.camera.rig import RIG_R_FACE, CubeRig


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
