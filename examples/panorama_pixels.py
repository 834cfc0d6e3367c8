"""A residual of points of your own: pixels of the panorama in place of angles on the sphere.

    gsba demo && python examples/panorama_pixels.py gsba-demo/walk pixel-run

Longitude and latitude are what a panorama's pixels count. Near the poles a pixel is a smaller
angle, and along the seam a longitude jumps: gsba's own bearings have neither. The residual is
compiled, and the points are eliminated as ever.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from factors import LandmarkResidual, LandmarkTerm, Term
from gsba import Family, PointObservations, RefineSettings, RunResult, refine

_LEAST_SINE = 0.05  # of the angle to a pole, nearer than which longitudes say nothing


@LandmarkResidual
def longitude_and_latitude(measured, vector, residual, jacobian):
    """Radians by which a point is right of and below the bearing (3,) it was measured at.

    Args:
        vector: (3,) from the lens to the point, rig frame: x right, y down, z forward.
        residual (2,), jacobian (2, 3): written.
    """
    x, y, z = vector
    across = np.sqrt(x * x + z * z)
    squared = across * across + y * y
    if across <= _LEAST_SINE * np.sqrt(squared):
        residual[0], residual[1] = np.pi, 0.0
        return False
    turn = np.arctan2(x, z) - np.arctan2(measured[0], measured[2])
    residual[0] = (turn + np.pi) % (2 * np.pi) - np.pi
    residual[1] = np.arctan2(y, across) - np.arcsin(measured[1])
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = z / across**2, 0.0, -x / across**2
    jacobian[1, 0] = -x * y / (across * squared)
    jacobian[1, 1] = across / squared
    jacobian[1, 2] = -z * y / (across * squared)
    return True


class PanoramaPixels(Family):
    """Pixels of the panorama, equally sharp in longitude and in latitude."""

    name, digest = "panorama_pixels", "1"
    observes_points = True

    def landmark_terms(self, observed: PointObservations) -> Sequence[Term]:
        seen = np.hypot(observed.bearings_rig[:, 0], observed.bearings_rig[:, 2]) > _LEAST_SINE
        origins = observed.origins_rig  # of two lenses, each ray starts at its own
        return [
            LandmarkTerm(
                observed.frames[seen],
                observed.points[seen],
                observed.bearings_rig[seen],
                longitude_and_latitude,
                observed.sigmas_rad[seen],
                name=self.name,
                origins_rig=None if origins is None else origins[seen],
            )
        ]


def main(walk: Path, out: Path) -> RunResult:
    """Refine a walk of the demo by pixels of its panoramas alone."""
    settings = RefineSettings(factors=())
    return refine(walk / "images", walk / "slam.tum", out, settings, families=[PanoramaPixels()])


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
