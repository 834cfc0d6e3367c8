"""Band along the seam of stitched panoramas within which both lenses are blended, or aligned by
optical flow: what it shows is seen from between the lenses."""

import logging
from dataclasses import replace

import numpy as np

from gsba.bundle.shared_parameters import ObservedRays, damped, models_of, summed
from gsba.camera.lens import Lenses, seam_sines

logger = logging.getLogger(__name__)

NARROWEST = float(np.deg2rad(4.0))  # half width of the band until an estimate has widened it
# edges of rings of directions, from the seam: each ring is judged beside all beyond the last edge
_EDGES = np.r_[NARROWEST, np.deg2rad([6.0, 8.0, 10.0, 12.0, 15.0, 20.0])]
_MIN_SIGMAS = 3.0
_MIN_SHORT = 0.05  # of a lens's distance from the middle, by which a ring's rays start nearer to it


def widened(rays: ObservedRays) -> Lenses:
    """The lenses so far with a band as wide as rays next to the seam start nearer to the middle
    between the lenses than rays further off.

    Each ring of directions has a share of its own by which its rays' origins are moved from or to
    the middle, poses and points adjusted with them all.
    """
    keypoints, shown, lenses = rays.keypoints, rays.shown, rays.lenses
    frames = keypoints.frames()

    def by_ring(rows: np.ndarray, by_origin: np.ndarray, _: np.ndarray) -> np.ndarray:
        directions, there = shown[rows], frames[rows]
        outwards = np.einsum("oij,oj->oi", by_origin, lenses.origins(directions, there))
        sines = seam_sines(lenses.own(directions, there), lenses.optical_axes)
        ring = np.searchsorted(np.sin(_EDGES), sines, side="right") - 1
        return outwards[:, :, None] * (ring[:, None] == np.arange(len(_EDGES)))[:, None]

    systems, _ = models_of(rays, by_ring)
    if not systems:
        return lenses
    total = summed(systems)
    covariance = np.linalg.inv(damped(total.curvature * total.hessian))
    outwards, variances = -covariance @ total.gradient, np.diagonal(covariance)
    short = outwards[-1] - outwards[:-1]  # beside rays that are far from the seam
    sigmas = np.sqrt(variances[:-1] + variances[-1] - 2 * covariance[:-1, -1])
    is_short = short > np.maximum(_MIN_SIGMAS * sigmas, _MIN_SHORT)
    widest = int(np.argmin(np.r_[is_short, False]))  # rings from the narrowest band outwards
    logger.debug("seam: origins are short by %s (sigma %s)", short.round(3), sigmas.round(3))
    return replace(lenses, band_rad=float(_EDGES[widest]))
