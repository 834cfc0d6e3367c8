"""Distances of a run's points to a scan of the place, before and after refinement."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsba.bundle.triangulation import points_under
from gsba.scans.files import normals_of
from gsba.scans.fit import Noise, approach, residuals_of, settle
from gsba.scans.judge import SIGMAS
from gsba.scans.registration import Registration, register
from gsba.scans.search import Guess
from gsba.scans.types import Cloud, Distances, Scan, cloud_of, distances_to
from gsba.similarity import Sim3, pose_similarity
from gsba.types import Reconstruction
from gsba.types.records import with_rows

_COLOR_STOPS = np.array(  # colours (C, 3) from distance 0 to the largest shown one
    [[38, 70, 140], [60, 160, 190], [120, 190, 110], [240, 200, 70], [200, 50, 40]], np.float64
)


@dataclass(frozen=True, slots=True)
class ScanErrors:
    """Distances of a run's points to a scan; lengths in the scan's unit."""

    registration: Registration  # of the refined cloud
    after: Distances  # of the refined points
    before: Distances | None  # of the points under the initial poses; None = there were none
    cloud: np.ndarray  # (N, 3) float64, refined points, world of the scan less its offset
    rows: np.ndarray  # (N,) int64, rows of these points in the reconstruction

    @property
    def furthest(self) -> float:
        """Largest distance that histograms and colours show."""
        parts = [self.after.values] + ([] if self.before is None else [self.before.values])
        return float(max(np.quantile(values, 0.9) for values in parts))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "registration": self.registration.to_json(),
            "after": self.after.to_json(self.furthest),
            "before": self.before and self.before.to_json(self.furthest),
        }

    def colors(self) -> np.ndarray:
        """Colours (N, 3) of the cloud's points by distance, see `colors_of`."""
        return colors_of(self.after.values, self.furthest)


def colors_of(distances: np.ndarray, furthest: float) -> np.ndarray:
    """Colours (N, 3) uint8 RGB of distances (N,): blue at 0, red at `furthest` and beyond."""
    at = np.clip(distances / max(furthest, 1e-12), 0, 1) * (len(_COLOR_STOPS) - 1)
    columns = [np.interp(at, np.arange(len(_COLOR_STOPS)), stop) for stop in _COLOR_STOPS.T]
    return np.round(np.stack(columns, axis=1)).astype(np.uint8)


def scan_errors(
    reconstruction: Reconstruction,
    scan: Scan,
    coarse_T_rigs: np.ndarray | None = None,
    guess: Guess | None = None,
) -> ScanErrors:
    """Distances of a run's points to a scan, after its refinement and before.

    The points before are the same observations, triangulated under the initial poses. Each cloud is
    aligned to the scan by its own best similarity: differences of their worlds do not count.

    Args:
        coarse_T_rigs: (F, 4, 4) initial poses of the frames, of any world and scale.
        guess: see `gsba.scans.registration`.

    Raises:
        GsbaError: the cloud fits the scan in no place, or in several.
    """
    cloud = cloud_of(reconstruction, normals_of)
    found = register(cloud, scan, guess)
    at = found.fit.similarity
    after = _distances(at, cloud, scan, found.fit.noise)
    before = None
    if coarse_T_rigs is not None:
        points = points_under(reconstruction, coarse_T_rigs)[cloud.rows]
        placed = at.points(
            pose_similarity(coarse_T_rigs, reconstruction.world_T_rigs).points(points)
        )
        good = np.isfinite(placed).all(axis=1)
        coarse = replace(
            with_rows(cloud, np.flatnonzero(good)), points=at.points_back(placed[good])
        )
        # largest offset of the unrefined cloud, part of the cloud's size
        width = 0.08 * cloud.size * at.scale
        near, sigma = approach(at, coarse, scan, width)
        fit = settle(near, coarse, scan, sigma)
        before = _distances(fit.similarity, coarse, scan, found.fit.noise)
    return ScanErrors(found, after, before, at.points(cloud.points), cloud.rows)


def _distances(at: Sim3, cloud: Cloud, scan: Scan, noise: Noise) -> Distances:
    carried, nearest, _, _ = residuals_of(at, cloud, scan)
    values = distances_to(scan, carried)
    sigmas = np.sqrt(noise.variances(at, cloud, scan, nearest))
    return Distances(values, float(np.mean(values <= SIGMAS * sigmas)))


def format_scan(errors: ScanErrors) -> str:
    """Text with the registration and a table of median, 90th percentile and inlier ratio."""
    rows = {"before": errors.before, "after": errors.after}
    lines = [f"{errors.registration}", "", f"{'':8}{'median':>10}{'90 %':>10}{'on it':>9}"]
    for name, found in rows.items():
        if found is not None:
            numbers = f"{found.median:10.4g}{found.percentile90:10.4g}{100 * found.explained:8.1f}%"
            lines.append(f"{name:8}{numbers}")
    return "\n".join(lines)
