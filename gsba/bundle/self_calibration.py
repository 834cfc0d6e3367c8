"""What the lenses of raw pairs are: focal lengths, distortion, and how the back one is turned.

Found from a map as other parameters that all frames share, beside the lenses' centre. What differs
from a calibration is believed where every part of the sequence gains by what the others give. Plain
lenses of unknown make are only a start, with priors as wide as such lenses differ: what is found is
taken where observations determine the focal lengths, in short sequences too. The front lens's axes
are the rig's, as it was calibrated: a turn of both is one of the poses.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from factors.bearing import tangent_basis
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.shared_parameters import (
    PARTS,
    SharedModel,
    models_of,
    predicts,
    summed,
    whole_model_of,
)
from gsba.camera.fisheye import PARAMETERS, Pair, by_parameters, changed, difference, recalibrated
from gsba.camera.lens import Lenses, facing
from gsba.types import Counts, Keypoints, Landmarks, Solution

logger = logging.getLogger(__name__)

_MOST = 60_000  # observations that it is found from
_PLACES = 500  # on the sphere, at which calibrations are compared
_TURN = 3  # of the parameters of a lens, the last ones
OF_FRONT, OF_BACK = PARAMETERS - _TURN, PARAMETERS  # parameters that each lens has
FREE = OF_FRONT + OF_BACK
_SIGMAS = np.array([0.05, 0.02, 0.02, 0.05, 0.02, 0.005, 0.001, 0.03, 0.03, 0.03])  # of a lens
SPREAD = np.concatenate([_SIGMAS[:OF_FRONT], _SIGMAS])  # (FREE,) standard deviations: how far
# lenses may be from what they were calibrated as, or from plain ones
_DETERMINED = 0.5  # of such a standard deviation, at most, that remains of what is determined
_GROUPS = {
    "focal lengths": [0, OF_FRONT],
    "principal points": [1, 2, OF_FRONT + 1, OF_FRONT + 2],
    "radial terms": [*range(3, OF_FRONT), *range(OF_FRONT + 3, FREE - _TURN)],
    "the back lens's turn": [*range(FREE - _TURN, FREE)],
}


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """What lenses are, as a map says."""

    lenses: Lenses  # with fisheyes of its own, if they were taken
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that what other parts give takes off, beside centres alone
    reason: str  # why none was taken; empty if one was
    counts: Counts  # of observations
    undetermined: tuple[str, ...] = ()  # what observations hardly tell more of than priors


def estimate(
    landmarks: Landmarks,
    keypoints: Keypoints,
    shown: np.ndarray,
    solved: Solution,
    so_far: Lenses,
    problem: AdjustmentContext,
    nominal: bool = False,
) -> SelfCalibration:
    """Find what lenses are from a map, poses, points and their centre adjusted with them.

    Args:
        landmarks: points and their observations.
        keypoints: of these, as rays under the lenses so far.
        shown: (N, 3) directions of the keypoints in their panoramas.
        solved: the map's poses, solved under these, and the noise of its observations.
        so_far: lenses of raw pairs.
        problem: priors, loss, settings.
        nominal: whether the lenses so far are plain ones of unknown make, not calibrated.
    """
    frames = keypoints.frames()

    def by_both(rows: np.ndarray, by_origin: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        own = by_lenses(keypoints.bearings_rig[rows], shown[rows], so_far, residuals)
        return np.concatenate([own, so_far.by_centre(by_origin, shown[rows], frames[rows])], axis=2)

    systems, counts = models_of(landmarks, _MOST, keypoints, solved, problem, by_both)
    off = from_calibrated(so_far)
    if nominal:
        whole = summed(systems) if systems else None
        whole = whole or whole_model_of(landmarks, _MOST, keypoints, solved, problem, by_both)
        if whole is not None:
            return _of_nominal(whole, so_far, off, counts)
    if not systems:
        why = "too few points to tell what lenses are"
        return SelfCalibration(so_far, np.full(PARTS, np.nan), why, counts)
    gains = []
    for p, part in enumerate(systems):
        others = systems[:p] + systems[p + 1 :]
        alone = np.concatenate([np.zeros(FREE), _centre_step(others)])
        gains.append(part.gain(_step(others, off)) - part.gain(alone))
    found, gains = _step(systems, off), np.array(gains)
    shares = gains / np.array([part.cost for part in systems])
    reason = ""
    if so_far.fisheyes is None and not predicts(gains):
        reason = "it does not predict parts of the sequence that it was not found from"
    logger.info(
        "lenses: focal lengths %+.3f and %+.3f %%, %.2f %% of unseen parts' cost%s",
        *(100 * (off + found[:FREE])[[0, OF_FRONT]]),
        100 * float(shares.mean()),
        reason and f"; not taken: {reason}",
    )
    lenses = so_far if reason else moved(so_far, found[:FREE])
    if not reason:
        lenses = replace(lenses, centre=so_far.centre + found[FREE:])
    return SelfCalibration(lenses, shares, reason, counts)


def _of_nominal(
    system: SharedModel, so_far: Lenses, off: np.ndarray, counts: Counts
) -> SelfCalibration:
    """What plain lenses of unknown make turn out to be, where focal lengths are determined.

    Args:
        system: of all observations.
        off: (FREE,) how far lenses are from the plain ones.
    """
    found, sigmas = _step([system], off), _sigmas(system)
    loose = undetermined(sigmas)
    focal = 100 * sigmas[[0, OF_FRONT]]
    reason = ""
    if "focal lengths" in loose:
        reason = (
            f"these frames tell focal lengths to {focal[0]:.1f} and {focal[1]:.1f} % only: lenses "
            "stay plain ones"
        )
    logger.info(
        "lenses: focal lengths %+.3f and %+.3f %% (sigmas %.3f and %.3f)%s%s",
        *(100 * (off + found[:FREE])[[0, OF_FRONT]]),
        *focal,
        f"; hardly determined: {', '.join(loose)}" if loose else "",
        reason and f"; not taken: {reason}",
    )
    lenses = so_far
    if not reason:
        lenses = moved(so_far, found[:FREE])
        lenses = replace(lenses, centre=so_far.centre + found[FREE:])
    return SelfCalibration(lenses, np.full(PARTS, np.nan), reason, counts, loose)


def undetermined(sigmas: np.ndarray) -> tuple[str, ...]:
    """What standard deviations (FREE,) after an adjustment are hardly smaller of than before."""
    loose = np.asarray(sigmas) > _DETERMINED * SPREAD
    return tuple(name for name, rows in _GROUPS.items() if loose[rows].mean() > 0.5)


def by_lenses(
    bearings_rig: np.ndarray,
    shown: np.ndarray,
    lenses: Lenses,
    residuals: np.ndarray | None = None,
) -> np.ndarray:
    """Jacobian (O, 2, FREE) of residuals of bearings by what lenses are.

    Noise is of pixels: it is an angle that shrinks where a focal length grows, and least squares of
    angles would prefer long ones. Taken where points are predicted, not where they were observed,
    the Jacobian is free of that noise, and so is what it finds.

    Args:
        bearings_rig: (O, 3) of the rays.
        shown: (O, 3) directions in the panoramas.
        lenses: of raw pairs.
        residuals: (O, 2) of the bearings, from observed to predicted; None = taken as 0.
    """
    out = np.zeros((len(shown), 2, FREE))
    basis, there = -tangent_basis(bearings_rig), lenses.calibrated(shown)
    if residuals is not None:
        there = there - np.einsum("oij,oi->oj", basis, residuals)
        there /= np.linalg.norm(there, axis=1, keepdims=True)
    front = facing(shown) > 0
    for part, lens, columns in zip(
        (front, ~front), now(lenses), (slice(OF_FRONT), slice(OF_FRONT, FREE)), strict=True
    ):
        moves = by_parameters(lens, there[part])[:, :, : columns.stop - (columns.start or 0)]
        out[part, :, columns] = basis[part] @ moves
    return out


def moved(lenses: Lenses, step: np.ndarray) -> Lenses:
    """Lenses after a step (FREE,) of what `by_lenses` differentiates by."""
    front, back = now(lenses)
    of_front = np.concatenate([step[:OF_FRONT], np.zeros(_TURN)])
    return replace(lenses, fisheyes=(changed(front, of_front), changed(back, step[OF_FRONT:])))


def from_calibrated(lenses: Lenses) -> np.ndarray:
    """How far (FREE,) lenses are from what they were calibrated as."""
    assert lenses.reference_calibration is not None
    of_front, of_back = (
        difference(one, before)
        for one, before in zip(now(lenses), lenses.reference_calibration, strict=True)
    )
    return np.concatenate([of_front[:OF_FRONT], of_back])


def apart(one: Lenses, other: Lenses) -> float:
    """How differently two calibrations of raw pairs take pixels, radians rms over the sphere."""
    if one.reference_calibration is None or one.fisheyes == other.fisheyes:
        return 0.0
    places = np.random.default_rng(0).normal(size=(_PLACES, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    there = recalibrated(places, now(one), now(other))
    return float(np.sqrt(np.mean(np.sum((there - places) ** 2, axis=1))))


def now(lenses: Lenses) -> Pair:
    """What lenses of raw pairs are taken for."""
    assert lenses.reference_calibration is not None
    return lenses.fisheyes or lenses.reference_calibration


def _pull() -> np.ndarray:
    """Information (FREE + 3,) on what lenses are, from what they were calibrated as."""
    return np.concatenate([SPREAD, np.full(3, np.inf)]) ** -2


def _step(systems: list[SharedModel], off: np.ndarray) -> np.ndarray:
    """Change (FREE + 3,) of lenses and centre that the parts ask for."""
    total, pull = summed(systems), _pull()
    gradient = total.gradient + pull * np.concatenate([off, np.zeros(3)])
    return -np.linalg.solve(total.curvature * total.hessian + np.diag(pull), gradient)


def _sigmas(system: SharedModel) -> np.ndarray:
    """Standard deviations (FREE,) of lenses, adjusted with centre, poses and points."""
    information = system.curvature * system.hessian + np.diag(_pull())
    information += 1e-12 * np.trace(information) * np.eye(len(information))
    return np.sqrt(np.diagonal(np.linalg.inv(information))[:FREE])


def _centre_step(systems: list[SharedModel]) -> np.ndarray:
    """Change (3,) of the centre that the parts ask for alone."""
    total = summed([each.of(slice(FREE, None)) for each in systems])
    return -np.linalg.solve(total.curvature * total.hessian, total.gradient)
