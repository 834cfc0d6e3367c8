"""Centres of the lenses, from points that cross the seam and from parallax: taken on trial where
parts of the sequence gain by them, and believed where they then predict other parts."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from factors.bearing import tangent_basis
from factors.camera_rows import half_baseline
from gsba.bundle.shared_parameters import (
    PARTS,
    ObservedRays,
    SharedModel,
    cross_validate,
    damped,
    models_of,
    newton_step,
    predicts,
    summed,
    whole_model,
)
from gsba.camera.lens import Lenses
from gsba.types import Counts

logger = logging.getLogger(__name__)

_MIN_SIGMAS = 5.0  # least distance from one centre, in standard deviations
_UNMODELLED = 0.005  # standard deviation of what no covariance shows, of the lenses' distance and
# the radius: measured on rendered walks (benchmarks/results/camera.md)


@dataclass(frozen=True, slots=True)
class LensCentres:
    """Centres of lenses estimated by a map."""

    lenses: Lenses  # with one centre if none was taken
    found: np.ndarray  # (3 (L - 1),) float64, centres as `Lenses.centre`, map units, taken or not
    covariance: np.ndarray  # float64, of these, poses and points adjusted with it
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that the centre of the other parts removes
    reason: str  # why nothing was taken; empty if it was
    counts: Counts  # of observations

    def scaled(self, scale: float) -> "LensCentres":
        """The centres in another unit of length: one map unit is `scale` of the new ones."""
        lenses, covariance = self.lenses.scaled(scale), scale**2 * self.covariance
        return replace(self, lenses=lenses, found=scale * self.found, covariance=covariance)


@dataclass(frozen=True, slots=True)
class StitchRadius:
    """Stitching radius: the distance at which panoramas have no parallax between lenses."""

    lenses: Lenses  # with inverse_stitch_radius, if it was taken
    centre: np.ndarray  # (3 (L - 1),) float64, as `Lenses.centre`, found beside the radius
    inverse_stitch_radius: float  # 1 / map units, inverse of the radius, taken or not
    sigma: float
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that the radius of the other parts removes, beside centres alone
    reason: str  # why nothing was taken; empty if it was

    def scaled(self, scale: float) -> "StitchRadius":
        """The radius in another unit of length: one map unit is `scale` of the new ones."""
        return replace(
            self,
            lenses=self.lenses.scaled(scale),
            centre=scale * self.centre,
            inverse_stitch_radius=self.inverse_stitch_radius / scale,
            sigma=self.sigma / scale,
        )

    def on_trial(self, lenses: Lenses) -> Lenses | None:
        """The lenses (solved for without a radius) to solve with before the radius is judged; None
        where they are stitched at infinity.

        Where most points lie beyond the radius, their parallax is reversed: the lenses come out in
        one another's place, and the radius negative.
        """
        inverse = self.inverse_stitch_radius
        if not self.reason or inverse > self.sigma:
            return replace(lenses, centre=self.centre, inverse_stitch_radius=inverse)
        if inverse < -_MIN_SIGMAS * self.sigma:
            return replace(lenses, centre=-self.centre, inverse_stitch_radius=-inverse)
        return None


def estimate(rays: ObservedRays) -> LensCentres:
    """Find the lenses' centres from a map, poses and points adjusted with them; `band_rad` of the
    lenses so far is kept."""
    chosen, so_far = rays.context.settings.camera, rays.lenses
    keypoints, frames = rays.keypoints, rays.keypoints.frames()

    def by_centre(rows: np.ndarray, by_origin: np.ndarray, _: np.ndarray) -> np.ndarray:
        return so_far.by_centre(by_origin, keypoints.bearings_rig[rows], frames[rows])

    systems, counts = models_of(rays, by_centre)
    # raw pairs have two lenses, even where frames are few
    raw = so_far.reference_calibration is not None
    total = whole_model(rays, systems, by_centre) if systems or raw else None
    if total is None:
        num = len(so_far.centre)
        unknown, nothing = np.full((num, num), np.nan), np.full(PARTS, np.nan)
        why = "too few points to tell one lens from the other"
        return LensCentres(so_far, so_far.centre, unknown, nothing, why, counts)
    covariance = np.linalg.inv(damped(total.hessian)) / total.curvature
    found = so_far.centre + _step([total])
    at_one = -so_far.centre  # as if there were one centre
    verdict = cross_validate(systems, _step, lambda _: at_one)
    gains = verdict.gains
    shares = verdict.shares if systems else np.full(PARTS, np.nan)
    strength = float(np.sqrt(found @ np.linalg.solve(covariance, found)))
    reason = ""
    if chosen.model == "auto" and not raw:
        # Matches that one centre has chosen hide the lenses from some parts of the sequence.
        if not (verdict.predicts if so_far else gains.sum() > 0):
            reason = "it does not predict parts of the sequence that it was not found from"
        # centres on trial are judged after matches were found with them, which may raise the
        # distance threefold
        elif strength < (_MIN_SIGMAS if so_far else 2.0):
            reason = f"one centre is as likely: {strength:.1f} standard deviations"
    where, untaken = np.array2string(found, precision=5), reason and f"; not taken: {reason}"
    gained = (
        f"{100 * float(shares.mean()):.1f} % of unseen parts' cost" if systems else "few frames"
    )
    logger.debug("lens centres: %s, %s%s", where, gained, untaken)
    taken = replace(so_far, centre=np.zeros_like(found) if reason else found)
    return LensCentres(taken, found, covariance, shares, reason, counts)


def baseline_of(centres: LensCentres, scale: float) -> tuple[float, float]:
    """Distance between the first two lenses at a scale of the map, and its standard deviation."""
    by_centres = half_baseline(centres.lenses.num_lenses)
    half = by_centres @ centres.found
    length = float(np.linalg.norm(half))
    along = half @ by_centres / max(length, 1e-300)
    sigma = float(np.sqrt(along @ centres.covariance @ along))
    return 2 * scale * length, 2 * scale * float(np.hypot(sigma, _UNMODELLED * length))


def radius_sigma(inverse: float, sigma: float) -> float:
    """Standard deviation of the inverse of a stitching radius, by the covariance of the adjustment
    and what is not modelled."""
    return float(np.hypot(sigma, _UNMODELLED * inverse))


def stitched_for(rays: ObservedRays) -> StitchRadius:
    """Find the radius that panoramas are stitched for, centres, poses and points adjusted with it.

    Where settings say it, that is it. Around lenses that were solved for without a radius it is a
    first estimate: their distance is wrong where there is one.
    """
    keypoints, shown, so_far = rays.keypoints, rays.shown, rays.lenses
    said = rays.context.settings.camera.inverse_stitch_radius(so_far.baseline / 2)
    if said is not None:
        reason, unknown = "" if said else "camera.stitch_radius_m says so", np.full(PARTS, np.nan)
        lenses = replace(so_far, inverse_stitch_radius=said)
        return StitchRadius(lenses, so_far.centre, said, 0.0, unknown, reason)
    frames, before = keypoints.frames(), so_far.inverse_stitch_radius

    def by_both(rows: np.ndarray, by_origin: np.ndarray, _: np.ndarray) -> np.ndarray:
        directions, there, bearings = shown[rows], frames[rows], keypoints.bearings_rig[rows]
        by_near = tangent_basis(bearings) @ so_far.origins(directions, there)[:, :, None]
        by_origin = by_origin + before * tangent_basis(bearings)
        return np.concatenate([so_far.by_centre(by_origin, directions, there), by_near], axis=2)

    systems, _ = models_of(rays, by_both)
    if not systems:
        unknown = np.full(PARTS, np.nan)
        return StitchRadius(so_far, so_far.centre, 0.0, np.nan, unknown, "too few points")
    num = len(so_far.centre)
    found, total = _step(systems), summed(systems)
    centre = so_far.centre + found[:num]
    # directions are bent by the centre times the inverse of the radius
    shortened = float(so_far.centre @ centre / max(centre @ centre, 1e-300))
    if not 0.1 < shortened < 10:  # beyond the reach of a linear model
        centre, shortened = so_far.centre, 1.0
    sigma = float(np.sqrt(np.linalg.inv(total.hessian)[num, num] / total.curvature)) * shortened
    verdict = cross_validate(systems, _step, lambda others: _step_to(others, -before))
    inverse_stitch_radius, shares = before + shortened * float(found[num]), verdict.shares
    logger.debug("inverse of the stitching radius: %.3f (sigma %.3f)", inverse_stitch_radius, sigma)
    reason = ""
    # one number gains less on unseen parts than many do
    predicted = predicts(verdict.gains, least=1.0)
    if not predicted or inverse_stitch_radius < 4.0 * sigma:
        reason = "as well stitched at infinity"
    lenses = replace(so_far, inverse_stitch_radius=0.0 if reason else inverse_stitch_radius)
    return StitchRadius(lenses, centre, inverse_stitch_radius, sigma, shares, reason)


_step = partial(newton_step, curved=True)


def _step_to(systems: Sequence[SharedModel], last: float) -> np.ndarray:
    """As `_step`, where the last parameter changes by `last`."""
    total = summed(systems)
    hessian = damped(total.curvature * total.hessian)
    rest = -np.linalg.solve(hessian[:-1, :-1], total.gradient[:-1] + last * hessian[:-1, -1])
    return np.r_[rest, last]
