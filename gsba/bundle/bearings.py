"""Bearings of the map's points: the family of the angle between measured and predicted rays."""

from collections.abc import Sequence

from factors import BearingTerm, Term
from gsba.bundle.families import Family
from gsba.bundle.point_observations import PointObservations


class Bearings(Family):
    """Directions to the map's points on the sphere: no seam, no pole, no face. See
    `factors.bearing`."""

    name = "bearing"
    digest = ""
    observes_points = True

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        """One bearing an observation."""
        return [
            BearingTerm(
                observed.frames,
                observed.points,
                observed.bearings_rig,
                observed.sigmas_rad,
                observed.sqrt_infos,
                origins_rig=observed.origins_rig,
            )
        ]
