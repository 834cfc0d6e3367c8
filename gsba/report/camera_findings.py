"""What was found of the camera, for report.json, and what to note of it."""

from typing import Any

import numpy as np

from gsba.bundle.camera_system import CameraCovariances
from gsba.bundle.lens_axes import LensAxes
from gsba.bundle.lens_centres import LensCentres, StitchRadius, baseline_of
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.self_calibration import FREE, OF_FRONT, SelfCalibration, undetermined
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.placement.placement import metres_per_unit

_CONTRADICTS = 3.0  # standard deviations between what is said of a camera and what images say


def of_camera(
    centres: LensCentres,
    readout: CameraEstimate | None,
    axes: LensAxes | None,
    radius: StitchRadius | None,
    known: CameraCovariances | None,
    scale: float,
    settings: CameraSettings,
    timed: bool,
) -> tuple[dict[str, Any], list[str]]:
    """Where the lenses are, where they look and how they are read.

    Args:
        centres: as the map has them.
        readout, axes, radius: the same; None = not looked for.
        known: how well; None = one centre is as likely.
        scale: of the map's unit in the world of the result.
        settings: what is said of the camera.
        timed: whether times of frames are known; if not, milliseconds are not.

    Returns:
        Lengths are in map units of the result; `metres_per_unit` rests on what is said.
    """
    length, sigma = baseline_of(centres, scale)
    said = {
        "taken": bool(centres.lenses),
        "reason": centres.reason,
        "front_lens": scale * centres.found,
        "front_lens_sigmas": scale * np.sqrt(np.diagonal(centres.covariance)),
        "baseline": length,
        "baseline_sigma": sigma,
        "gain_of_unseen_parts": centres.part_gains,
    }
    notes, baseline = [], settings.baseline()
    if not centres.lenses:
        if baseline is not None:
            notes.append(f"two lenses were not found, and tell no scale: {centres.reason}")
        return said, notes
    notes.append(f"these frames are of two lenses {length:.5g} map units apart (sigma {sigma:.1g})")
    if baseline is not None:
        metres, of_metres = metres_per_unit((length, sigma), baseline)
        said |= {"metres_per_unit": metres, "metres_per_unit_sigma": of_metres}
        notes.append(_scale_note(metres, of_metres, baseline[0]))
    if axes is not None:
        said["turned_below_panorama"] = centres.lenses.axes is not None
        said["gain_of_axes"] = axes.gains
        if centres.lenses.axes is not None:
            notes.append("the lenses turn below the panoramas: a stabiliser was on")
    inverse_stitch_radius = centres.lenses.inverse_stitch_radius
    if radius is not None:
        said["stitch_radius"] = _of_radius(radius, inverse_stitch_radius, known, scale)
    if inverse_stitch_radius:
        notes.append(
            f"they are stitched for a radius of {scale / inverse_stitch_radius:.3g} map units"
        )
    if readout is not None:
        said["readout"] = _of_readout(readout, timed)
        if timed:
            notes += _readout_notes(readout, settings)
    return said, notes


def of_lenses(
    lenses: Lenses, voted: SelfCalibration | None, known: CameraCovariances | None
) -> tuple[dict[str, Any], list[str]]:
    """What the lenses of raw pairs are.

    Args:
        lenses: as the map has them.
        voted: what features said of those that were given; None = they were found.
        known: how well they are known.
    """
    if lenses.fisheyes is None:
        reason = "" if voted is None else voted.reason
        return {"taken": False, "reason": reason}, []
    sigmas = np.full(FREE, np.nan)
    if known is not None and known.lens_sigmas is not None:
        sigmas = known.lens_sigmas
    said, notes = dict[str, Any](taken=True, reason=""), []
    of_lens = sigmas[:OF_FRONT], sigmas[OF_FRONT:]
    for name, lens, own in zip(("front", "back"), lenses.fisheyes, of_lens, strict=True):
        said[name] = {
            "focal": lens.focal,
            "focal_sigma": lens.focal * own[0],
            "principal": lens.principal,
            "principal_sigmas": lens.focal * own[1:3],
            "radial": lens.radial,
            "radial_sigmas": own[3:7],
        }
    said["back"]["turn_sigmas_deg"] = np.rad2deg(of_lens[1][7:])
    loose = undetermined(sigmas)
    said["hardly_determined"] = loose
    if loose:
        notes.append(
            f"these frames hardly determine of the lenses: {', '.join(loose)} (they stay near what "
            "lenses were taken for)"
        )
    front, back = (said[name] for name in ("front", "back"))
    notes.append(
        f"the lenses were calibrated as found: focal lengths {front['focal']:.2f} and "
        f"{back['focal']:.2f} pixels (sigmas {front['focal_sigma']:.1g} and "
        f"{back['focal_sigma']:.1g}); calibration.json is for other runs of this camera"
    )
    return said, notes


def _scale_note(metres: float, sigma: float, baseline: float) -> str:
    return (
        f"one map unit is {metres:.4g} m (sigma {100 * sigma / metres:.2g} %), the lenses "
        f"{1e3 * baseline:g} mm apart"
    )


def _of_radius(
    radius: StitchRadius,
    inverse_stitch_radius: float,
    known: CameraCovariances | None,
    scale: float,
) -> dict[str, Any]:
    sigma = radius.sigma if known is None else known.inverse_stitch_radius_sigma
    return {
        "taken": not radius.reason,
        "reason": radius.reason,
        "inverse": (inverse_stitch_radius or radius.inverse_stitch_radius) / scale,
        "inverse_sigma": (sigma if inverse_stitch_radius else radius.sigma) / scale,
        "gain_of_unseen_parts": radius.part_gains,
    }


def _of_readout(found: CameraEstimate, timed: bool) -> dict[str, Any]:
    taken = found.lenses.readout_motion is not None
    return {
        "taken": taken,
        "reason": found.reason,
        "ms": 1e3 * found.readout_s if timed else None,
        "ms_sigma": 1e3 * found.readout_sigma if timed else None,
        "rows_run_along": found.lenses.row_directions if taken else None,
        "gain_of_unseen_parts": found.gains,
    }


def _readout_notes(found: CameraEstimate, settings: CameraSettings) -> list[str]:
    """What the images say of the readout, and whether it is what was said."""
    if found.lenses.readout_motion is None:
        return []
    notes = [
        f"rows are read in {1e3 * found.readout_s:.1f} ms (sigma {1e3 * found.readout_sigma:.1g}), "
        "frames moving meanwhile"
    ]
    said = settings.readout()
    if said is not None:
        off = abs(found.readout_s - said[0])
        if off > _CONTRADICTS * np.hypot(found.readout_sigma, said[1]):
            notes.append(f"{1e3 * said[0]:g} ms were expected: is it the camera that is named?")
    return notes
