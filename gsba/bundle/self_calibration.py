"""What the lenses of raw pairs are: focal lengths, distortion, and how the back one is turned.

Found from a map as other parameters that all frames share, beside the lenses' centre, and believed
where every part of the sequence gains by what the others give. The front lens's axes are the rig's,
as it was calibrated: a turn of both is one of the poses.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from factors.bearing import tangent_basis
from gsba.bundle.adjustment import Problem
from gsba.bundle.shared_parameters import (
    PARTS,
    SharedModel,
    models_of,
    predicts,
    summed,
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


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """What lenses are, as a map says."""

    lenses: Lenses  # with fisheyes of its own, if they were taken
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that what other parts give takes off, beside centres alone
    reason: str  # why none was taken; empty if one was
    counts: Counts  # of observations


def estimate(
    landmarks: Landmarks,
    keypoints: Keypoints,
    shown: np.ndarray,
    solved: Solution,
    so_far: Lenses,
    problem: Problem,
) -> SelfCalibration:
    """Find what lenses are from a map, poses, points and their centre adjusted with them.

    Args:
        landmarks: points and their observations.
        keypoints: of these, as rays under the lenses so far.
        shown: (N, 3) directions of the keypoints in their panoramas.
        solved: the map's poses, solved under these, and the noise of its observations.
        so_far: lenses of raw pairs.
        problem: priors, loss, settings.
    """
    frames = keypoints.frames()

    def by_both(rows: np.ndarray, by_origin: np.ndarray) -> np.ndarray:
        own = by_lenses(keypoints.bearings_rig[rows], shown[rows], so_far)
        return np.concatenate([own, so_far.by_centre(by_origin, shown[rows], frames[rows])], axis=2)

    systems, counts = models_of(landmarks, _MOST, keypoints, solved, problem, by_both)
    if not systems:
        why = "too few points to tell what lenses are"
        return SelfCalibration(so_far, np.full(PARTS, np.nan), why, counts)
    off = from_calibrated(so_far)
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


def by_lenses(bearings_rig: np.ndarray, shown: np.ndarray, lenses: Lenses) -> np.ndarray:
    """Jacobian (O, 2, FREE) of residuals of bearings by what lenses are.

    Args:
        bearings_rig: (O, 3) of the rays.
        shown: (O, 3) directions in the panoramas.
        lenses: of raw pairs.
    """
    out = np.zeros((len(shown), 2, FREE))
    basis, there = -tangent_basis(bearings_rig), lenses.calibrated(shown)
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
    assert lenses.cut_by is not None
    of_front, of_back = (
        difference(one, before) for one, before in zip(now(lenses), lenses.cut_by, strict=True)
    )
    return np.concatenate([of_front[:OF_FRONT], of_back])


def apart(one: Lenses, other: Lenses) -> float:
    """How differently two calibrations of raw pairs take pixels, radians rms over the sphere."""
    if one.cut_by is None or one.fisheyes == other.fisheyes:
        return 0.0
    places = np.random.default_rng(0).normal(size=(_PLACES, 3))
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    there = recalibrated(places, now(one), now(other))
    return float(np.sqrt(np.mean(np.sum((there - places) ** 2, axis=1))))


def now(lenses: Lenses) -> Pair:
    """What lenses of raw pairs are taken for."""
    assert lenses.cut_by is not None
    return lenses.fisheyes or lenses.cut_by


def _pull() -> np.ndarray:
    """Information (FREE + 3,) on what lenses are, from what they were calibrated as."""
    return np.concatenate([SPREAD, np.full(3, np.inf)]) ** -2


def _step(systems: list[SharedModel], off: np.ndarray) -> np.ndarray:
    """Change (FREE + 3,) of lenses and centre that the parts ask for."""
    total, pull = summed(systems), _pull()
    gradient = total.gradient + pull * np.concatenate([off, np.zeros(3)])
    return -np.linalg.solve(total.curvature * total.hessian + np.diag(pull), gradient)


def _centre_step(systems: list[SharedModel]) -> np.ndarray:
    """Change (3,) of the centre that the parts ask for alone."""
    total = summed([each.of(slice(FREE, None)) for each in systems])
    return -np.linalg.solve(total.curvature * total.hessian, total.gradient)
