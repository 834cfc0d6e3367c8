"""Stitching field: displacements of bearings by calibration and stitching, fixed to the rig."""

import logging
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from factors.bearing import tangent_basis
from factors.sphere_field import SphereField, degrees_of, harmonics, num_harmonics
from gsba.bundle import adjustment
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.observation_noise import with_scaled_noise
from gsba.bundle.shared_parameters import (
    MAX_OBSERVATIONS,
    PARTS,
    BySharedParameters,
    ObservedRays,
    SharedModel,
    cross_validate,
    models_of,
)
from gsba.camera.cameras import ONE_CAMERA, Cameras
from gsba.camera.rig import CubeRig, owner_faces
from gsba.types import Counts, Keypoints, Round, Sighted, Solution

_MAX_DEGREE = 10  # of spherical harmonics: the shortest wavelength is 36 degrees
_MIN_GAIN = 0.03  # share by which the field must lower the robust cost of held-out observations

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Stitching:
    """A field, and the map solved with it."""

    field: SphereField  # coefficients (0,): nothing is corrected
    adjustment: Solution
    keypoints: Keypoints  # of the adjustment, as observed
    degree: int  # of the best field, taken or not
    part_gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part of the
    # sequence that the field of the other parts takes off, poses and points adjusted with and
    # without it
    counts: Counts  # of observations the field was found from

    @property
    def rounds(self) -> tuple[Round, ...]:
        """Of the adjustment, if there is a field."""
        return self.adjustment.rounds if self.field else ()


def corrected(keypoints: Keypoints, field: SphereField, rig: CubeRig) -> Keypoints:
    """Keypoints with the field removed: bearings, faces, pixels and noise."""
    if not field:
        return keypoints
    bearings, roots = field.corrected(keypoints.bearings_rig), keypoints.sqrt_infos
    if roots is not None:
        roots = field.corrected_roots(keypoints.bearings_rig, roots)
    faces = owner_faces(bearings)
    pixels = rig.project(bearings, faces)
    return replace(keypoints, bearings_rig=bearings, sqrt_infos=roots, faces=faces, pixels=pixels)


def with_noise_of(
    keypoints: Keypoints, calibrated: Keypoints, scratch: Path | None = None
) -> Keypoints:
    """Keypoints whose noise is scaled as in others of the same rows, where they were corrected; a
    folder on the disk takes the noise of many, None = it is in memory."""
    factors = calibrated.sigmas_rad / keypoints.sigmas_rad
    scaled = with_scaled_noise(keypoints, factors, scratch)
    return replace(scaled, sigmas_rad=calibrated.sigmas_rad)  # to the byte


def estimate(
    sighted: Sighted,
    keypoints: Keypoints,
    before: Solution,
    field: SphereField,
    context: AdjustmentContext,
    lenses: Cameras = ONE_CAMERA,
) -> Stitching:
    """Find the field, by cross-validation over parts of the sequence, and solve the map with it.
    `sighted` and the keypoints are as observed, the latter with the noise they turned out to have.

    Points are shared out among parts of the sequence by their mean frame. A part's cost is a
    quadratic function of the field once its points and poses are eliminated; sums of those of the
    other parts give fields of every degree and smoothness, and the part itself says what they are
    worth. The field is taken where every part gains, and all together enough.
    """
    whole = MAX_OBSERVATIONS, _MAX_DEGREE, _MIN_GAIN
    probe = 20_000, 4, 0.5 * _MIN_GAIN  # a first look, of a low degree
    now = Stitching(field, before, keypoints, 0, np.zeros(PARTS), Counts(0, 0, "observations"))
    systems, spread = [], 0.0
    for most, max_degree, least in [whole] if field else [probe, whole]:
        systems, counts = _systems(now, most, max_degree, context, lenses)
        if not systems:
            return replace(now, counts=counts)
        # the smoothest field that predicts parts well
        # radians, of coefficients of degree 1; falls with the square of the degree
        tried = [
            (d, spread, cross_validate(systems, partial(_fitted, degree=d, spread=spread)))
            for spread in (1e-4, 3e-4, 1e-3, 3e-3)
            for d in range(1, max_degree + 1)
        ]
        best = max(verdict.gains.sum() for _, _, verdict in tried)
        enough = min(0.95 * best, best)
        degree, spread, verdict = next(each for each in tried if each[2].gains.sum() >= enough)
        gains = verdict.gains
        costs = np.array([part.cost for part in systems])
        now = replace(now, degree=degree, part_gains=gains / costs, counts=counts)
        if gains.sum() < least * costs.sum() or np.any(gains <= 0):
            return now
    for number in range(2):  # estimates of the field, each with a bundle adjustment
        if number:
            systems, _ = _systems(now, MAX_OBSERVATIONS, _MAX_DEGREE, context, lenses)
        field = SphereField(_fitted(systems, now.degree, spread))
        straight = corrected(sighted.keypoints, field, context.rig)
        there = replace(sighted, keypoints=lenses.seen(straight))
        gates = adjustment.ALIGNED_GATES[-1:]
        solved, found = adjustment.adjust_sighted(there, now.adjustment, context, gates)
        keypoints = with_noise_of(sighted.keypoints, found)
        now = replace(now, field=field, adjustment=solved, keypoints=keypoints)
    logger.info("stitching: %.4f deg rms, degree %d", np.rad2deg(field.rms_rad), now.degree)
    return now


def _systems(
    now: Stitching, most: int, max_degree: int, context: AdjustmentContext, lenses: Cameras
) -> tuple[list[SharedModel], Counts]:
    """Models of the cost of each part of the sequence; none where there is too little."""
    there, solved = lenses.seen(corrected(now.keypoints, now.field, context.rig)), now.adjustment
    by_field = _by_field(now.keypoints, there, max_degree)
    models, counts = models_of(ObservedRays(solved, there, context, most=most), by_field)
    return [model.around(now.field.coefficients) for model in models], counts


def _by_field(keypoints: Keypoints, there: Keypoints, max_degree: int) -> BySharedParameters:
    """Jacobian of residuals by a field, as in `models_of`, where it takes keypoints to `there`."""

    def by_field(rows: np.ndarray, _origin: np.ndarray, _residuals: np.ndarray) -> np.ndarray:
        basis = harmonics(keypoints.bearings_rig[rows], max_degree)
        return -tangent_basis(there.bearings_rig[rows]) @ basis

    return by_field


def _fitted(systems: list[SharedModel], degree: int, spread: float) -> np.ndarray:
    """Coefficients (K,) of the field that minimise the cost of the parts, with a prior of zero."""
    num = num_harmonics(degree)
    pull = degrees_of(num) ** 4 / spread**2
    gradient = sum(part.gradient[:num] for part in systems)
    hessian = sum((part.hessian[:num, :num] for part in systems), np.diag(pull))
    return -np.linalg.solve(hessian, gradient)
