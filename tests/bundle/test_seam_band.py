"""Band along the seam of stitched panoramas: as wide as what is seen from between the lenses."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from lens_world import placed, problem_of, seen_through, solved_under

from gsba.bundle import seam_band
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.lens import Lenses, seam_sines
from gsba.geometry import unit
from gsba.types import Solution

TRUE = Lenses(np.array([0.004, -0.003, 0.05]))


@dataclass(frozen=True)
class Stitcher:
    """Shows, from the edge of a band to the seam, what is seen from ever nearer to the middle."""

    band_deg: float

    def seeing(self, points_rig: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Vectors (N, 3) to points (N, 3)."""
        off_seam = np.arcsin(np.minimum(seam_sines(unit(points_rig), TRUE.optical_axes), 1))
        share = np.minimum(off_seam / np.deg2rad(self.band_deg), 1)
        return points_rig - share[:, None] * TRUE.origins(points_rig, frames)


@pytest.mark.parametrize(
    ("band_deg", "least", "most"), [(0.01, 4, 4), (4, 4, 4), (12, 10, 12), (40, 20, 20)]
)
def test_the_band_is_as_wide_as_origins_are_short(
    band_deg: float, least: float, most: float
) -> None:
    """Within a twentieth of the lens's distance; no ring is judged beyond 20 degrees."""
    world, shown = seen_through(Stitcher(band_deg))  # type: ignore[arg-type]
    lenses = replace(TRUE, band_rad=seam_band.NARROWEST)
    start = Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, lenses, start)
    around = replace(solved, landmarks=placed(solved, keypoints, tracks))
    given = around, keypoints, problem_of(world), lenses, shown.bearings_rig
    found = seam_band.widened(ObservedRays(*given))
    assert least <= round(float(np.rad2deg(found.band_rad)), 6) <= most
    np.testing.assert_array_equal(found.centre, lenses.centre)
