"""Self-calibration of raw lenses: focal lengths, distortion, rotations of all but the front one.

Plain lenses of unknown make are only a start, with priors as wide as such lenses differ: what is
found is taken where observations determine the focal lengths. Parameters (K,) are those of the
front lens but its rotation, then all of each other lens.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from factors.bearing import tangent_basis
from gsba.bundle.shared_parameters import (
    PARTS,
    ObservedRays,
    SharedModel,
    cross_validate,
    models_of,
    newton_step,
    summed,
    whole_model,
)
from gsba.camera.fisheye import PARAMETERS, Rig, by_parameters, changed, difference, recalibrated
from gsba.camera.lens import Lenses
from gsba.geometry import unit
from gsba.types import Counts

logger = logging.getLogger(__name__)

_TURN = 3  # number of the last parameters of a lens, its rotation
OF_FRONT = PARAMETERS - _TURN  # parameters of the front lens
_SIGMAS = np.array([0.05, 0.02, 0.02, 0.05, 0.02, 0.005, 0.001, 0.03, 0.03, 0.03])  # prior standard
# deviations of a lens
_GROUPS = {  # parameters of each lens
    "focal lengths": [0],
    "principal points": [1, 2],
    "radial terms": [*range(3, OF_FRONT)],
    "the other lenses' rotations": [*range(OF_FRONT, PARAMETERS)],
}


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """Lenses calibrated by a map."""

    lenses: Lenses  # with the estimated fisheyes, if they were taken
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that the calibration of the other parts removes, beside centres alone
    reason: str  # why no calibration was taken; empty if one was
    counts: Counts  # of observations


def estimate(rays: ObservedRays, nominal: bool = False) -> SelfCalibration:
    """Calibrate lenses by a map, poses, points and lens centres adjusted with them; nominal:
    whether these lenses are plain ones of unknown make, not calibrated."""
    keypoints, shown, so_far = rays.keypoints, rays.shown, rays.lenses
    frames, num = keypoints.frames(), num_parameters(so_far.num_lenses)

    def by_both(rows: np.ndarray, by_origin: np.ndarray, residuals: np.ndarray) -> np.ndarray:
        own = by_lenses(keypoints.bearings_rig[rows], shown[rows], so_far, residuals)
        return np.concatenate([own, so_far.by_centre(by_origin, shown[rows], frames[rows])], axis=2)

    systems, counts = models_of(rays, by_both)
    off = from_calibrated(so_far)
    if nominal:
        whole = whole_model(rays, systems, by_both)
        if whole is not None:
            return _of_nominal(whole, so_far, off, counts)
    if not systems:
        why = "too few points to tell what lenses are"
        return SelfCalibration(so_far, np.full(PARTS, np.nan), why, counts)

    def centres_alone(others: list[SharedModel]) -> np.ndarray:
        centres = newton_step([each.of(slice(num, None)) for each in others], curved=True)
        return np.r_[np.zeros(num), centres]

    verdict = cross_validate(systems, lambda others: _step(others, off), centres_alone)
    found, shares = _step(systems, off), verdict.shares
    reason = ""
    if so_far.fisheyes is None and not verdict.predicts:
        reason = "it does not predict parts of the sequence that it was not found from"
    logger.info(
        "lenses: focal lengths %s %%, %.2f %% of unseen parts' cost%s",
        _shown(100 * (off + found[:num])[focals_of(so_far.num_lenses)]),
        100 * float(shares.mean()),
        reason and f"; not taken: {reason}",
    )
    lenses = so_far if reason else _moved_all(so_far, found)
    return SelfCalibration(lenses, shares, reason, counts)


def _of_nominal(
    system: SharedModel, so_far: Lenses, off: np.ndarray, counts: Counts
) -> SelfCalibration:
    """Calibration of plain lenses of unknown make, where focal lengths are determined."""
    num = len(off)
    pull = _pull(len(system.gradient), num)
    information = system.curvature * system.hessian + np.diag(pull)
    information += 1e-12 * np.trace(information) * np.eye(len(information))
    found, sigmas = _step([system], off), np.sqrt(np.diagonal(np.linalg.inv(information))[:num])
    loose, focals = undetermined(sigmas), focals_of(so_far.num_lenses)
    focal = 100 * sigmas[focals]
    reason = ""
    if "focal lengths" in loose:
        shown = " and ".join(f"{one:.1f}" for one in focal)
        reason = f"these frames tell focal lengths to {shown} % only: lenses stay plain ones"
    logger.info(
        "lenses: focal lengths %s %% (sigmas %s)%s%s",
        _shown(100 * (off + found[:num])[focals]),
        _shown(focal),
        f"; hardly determined: {', '.join(loose)}" if loose else "",
        reason and f"; not taken: {reason}",
    )
    lenses = so_far if reason else _moved_all(so_far, found)
    return SelfCalibration(lenses, np.full(PARTS, np.nan), reason, counts)


def undetermined(sigmas: np.ndarray) -> tuple[str, ...]:
    """Groups of parameters whose standard deviations (K,) the adjustment hardly lowers."""
    num = num_lenses_of(len(sigmas))
    loose = np.asarray(sigmas) > 0.5 * spread(num)
    starts = [0, *(first_of(lens) for lens in range(1, num))]
    found = []
    for name, rows in _GROUPS.items():
        turn = rows[0] >= OF_FRONT  # the front lens has none
        whole = [start + row for start in starts[turn:] for row in rows]
        if loose[whole].mean() > 0.5:
            found.append(name)
    return tuple(found)


def first_of(lens: int) -> int:
    """Where the parameters of a lens start."""
    return 0 if lens == 0 else OF_FRONT + PARAMETERS * (lens - 1)


def num_parameters(num_lenses: int) -> int:
    """K, of raw lenses."""
    return first_of(num_lenses)


def num_lenses_of(num: int) -> int:
    """L, of raw lenses with K parameters."""
    return 1 + (num - OF_FRONT) // PARAMETERS


def focals_of(num_lenses: int) -> list[int]:
    """Where the focal lengths of lenses are among the parameters."""
    return [first_of(lens) for lens in range(num_lenses)]


def spread(num_lenses: int) -> np.ndarray:
    """Standard deviations (K,) of lenses about calibrated or plain ones."""
    return np.concatenate([_SIGMAS[:OF_FRONT], *[_SIGMAS] * (num_lenses - 1)])


def by_lenses(
    bearings_rig: np.ndarray, shown: np.ndarray, lenses: Lenses, residuals: np.ndarray | None = None
) -> np.ndarray:
    """Jacobian (O, 2, K) of residuals (O, 2) of bearings (O, 3), from observed to predicted, None =
    0, by the parameters of lenses; shown: (O, 3) directions in the panoramas.

    Noise is of pixels: it is an angle that shrinks where a focal length grows, and least squares of
    angles would prefer long ones. Taken where points are predicted, not where they were observed,
    the Jacobian is free of that noise, and so is what it finds.
    """
    out = np.zeros((len(shown), 2, num_parameters(lenses.num_lenses)))
    basis, there = -tangent_basis(bearings_rig), lenses.calibrated(shown)
    if residuals is not None:
        there = unit(there - np.einsum("oij,oi->oj", basis, residuals))
    facing = lenses.facing(shown, np.zeros(len(shown), int))
    for number, lens in enumerate(now(lenses)):
        part, columns = facing == number, slice(first_of(number), first_of(number + 1))
        moves = by_parameters(lens, there[part])[:, :, : columns.stop - columns.start]
        out[part, :, columns] = basis[part] @ moves
    return out


def moved(lenses: Lenses, step: np.ndarray) -> Lenses:
    """Lenses after a step (K,) of the parameters of `by_lenses`."""
    front, *others = now(lenses)
    steps = np.split(step, [first_of(lens) for lens in range(1, lenses.num_lenses)])
    found = [changed(front, np.concatenate([steps[0], np.zeros(_TURN)]))]
    found += [changed(lens, own) for lens, own in zip(others, steps[1:], strict=True)]
    return replace(lenses, fisheyes=tuple(found))


def _moved_all(lenses: Lenses, step: np.ndarray) -> Lenses:
    """Lenses and their centres after a step."""
    num = num_parameters(lenses.num_lenses)
    return replace(moved(lenses, step[:num]), centre=lenses.centre + step[num:])


def from_calibrated(lenses: Lenses) -> np.ndarray:
    """Step (K,) from the reference calibration to the lenses."""
    assert lenses.reference_calibration is not None
    front, *others = (
        difference(one, before)
        for one, before in zip(now(lenses), lenses.reference_calibration, strict=True)
    )
    return np.concatenate([front[:OF_FRONT], *others])


def apart(one: Lenses, other: Lenses) -> float:
    """Difference of two calibrations of raw lenses in bearings of pixels, radians rms."""
    if one.reference_calibration is None or one.fisheyes == other.fisheyes:
        return 0.0
    places = unit(np.random.default_rng(0).normal(size=(500, 3)))
    there = recalibrated(places, now(one), now(other))
    return float(np.sqrt(np.mean(np.sum((there - places) ** 2, axis=1))))


def now(lenses: Lenses) -> Rig:
    """The estimated calibration of raw lenses; the reference where none is estimated."""
    assert lenses.reference_calibration is not None
    return lenses.fisheyes or lenses.reference_calibration


def _pull(num: int, of_lenses: int) -> np.ndarray:
    """Prior information (num,) on lenses and centres, about their calibration; of_lenses: number
    of the lenses' parameters, which are the first ones."""
    pull = np.zeros(num)
    pull[:of_lenses] = spread(num_lenses_of(of_lenses)) ** -2
    return pull


def _step(systems: list[SharedModel], off: np.ndarray) -> np.ndarray:
    """Change (K + 3 (L - 1),) of lenses and centres that minimises the cost of the parts."""
    total = summed(systems)
    num = len(total.gradient)
    pull, whole = _pull(num, len(off)), np.zeros(num)
    whole[: len(off)] = off
    gradient = total.gradient + pull * whole
    return -np.linalg.solve(total.curvature * total.hessian + np.diag(pull), gradient)


def _shown(values: np.ndarray) -> str:
    return " and ".join(f"{value:+.3f}" for value in values)
