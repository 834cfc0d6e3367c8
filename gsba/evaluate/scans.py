"""A run's cloud against a scan of the place: how far off its points are, and were before."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.bundle.triangulation import points_under
from gsba.scans.distances import Distances, distances_to
from gsba.scans.files import normals_of
from gsba.scans.fit import approach, settle
from gsba.scans.judge import SIGMAS
from gsba.scans.noise import Noise, residuals_of
from gsba.scans.registration import Registration, register
from gsba.scans.search import Guess
from gsba.scans.types import Cloud, Scan, cloud_of
from gsba.similarity import Sim3, pose_similarity
from gsba.types import Reconstruction

_BEFORE = 0.08  # of the cloud's size: how far off the cloud before may be
_SHOWN = 0.9  # of the points before, that a histogram spans
_STOPS = np.array(  # colours (C, 3) from no distance to the largest shown one
    [[38, 70, 140], [60, 160, 190], [120, 190, 110], [240, 200, 70], [200, 50, 40]], np.float64
)


@dataclass(frozen=True, slots=True)
class ScanErrors:
    """What a scan says of a run; lengths in its unit."""

    registration: Registration  # of the refined cloud
    after: Distances
    before: Distances | None  # the same points under the poses before; None = there were none
    cloud: np.ndarray  # (N, 3) float64, refined, world of the scan less its offset
    rows: np.ndarray  # (N,) int64: which points of the reconstruction these are

    @property
    def furthest(self) -> float:
        """How far histograms and colours reach."""
        parts = [self.after.values] + ([] if self.before is None else [self.before.values])
        return float(max(np.quantile(values, _SHOWN) for values in parts))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "registration": self.registration.to_json(),
            "after": self.after.to_json(self.furthest),
            "before": self.before and self.before.to_json(self.furthest),
        }

    def colors(self) -> np.ndarray:
        """Of the cloud's points, see `colors_of`."""
        return colors_of(self.after.values, self.furthest)


def colors_of(distances: np.ndarray, furthest: float) -> np.ndarray:
    """Colours (N, 3) uint8 RGB of distances (N,): blue is near, red as far as `furthest`."""
    at = np.clip(distances / max(furthest, 1e-12), 0, 1) * (len(_STOPS) - 1)
    columns = [np.interp(at, np.arange(len(_STOPS)), stop) for stop in _STOPS.T]
    return np.round(np.stack(columns, axis=1)).astype(np.uint8)


def scan_errors(
    reconstruction: Reconstruction,
    scan: Scan,
    coarse_T_rigs: np.ndarray | None = None,
    guess: Guess | None = None,
) -> ScanErrors:
    """Distances of a run's points to a scan, after its refinement and before.

    Before, the same observations are triangulated under the poses before. Both clouds are laid on
    the scan each by its own best similarity, so that neither's frame counts against it.

    Args:
        reconstruction: refined.
        scan: of the same place.
        coarse_T_rigs: (F, 4, 4) poses of the frames before, of any world and scale.
        guess: see `gsba.scans.registration`.

    Raises:
        GsbaError: the cloud has no place in the scan, or several.
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
        coarse = cloud.taken(np.flatnonzero(good)).at(at.points_back(placed[good]))
        width = _BEFORE * cloud.size * at.scale
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
    """A table for people, and how distances are distributed."""
    rows = {"before": errors.before, "after": errors.after}
    lines = [f"{errors.registration}", "", f"{'':8}{'median':>10}{'90 %':>10}{'on it':>9}"]
    for name, found in rows.items():
        if found is not None:
            numbers = f"{found.median:10.4g}{found.percentile90:10.4g}{100 * found.explained:8.1f}%"
            lines.append(f"{name:8}{numbers}")
    return "\n".join(lines)
