"""Findings on the camera, for report.json, and notes for the user."""

from typing import Any

import numpy as np

from gsba.bundle.camera_adjustment import CameraSigmas
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import baseline_of, radius_sigma
from gsba.bundle.readout import TWO_INSTANTS, CameraEstimate
from gsba.bundle.self_calibration import first_of, num_parameters, undetermined
from gsba.camera.fisheye import lens_names
from gsba.camera.lens import all_centres
from gsba.config import CameraSettings
from gsba.placement.placement import metres_per_unit


def of_camera(
    found: FoundCamera,
    known: CameraSigmas | None,
    scale: float,
    settings: CameraSettings,
    timed: bool,
) -> tuple[dict[str, Any], list[str]]:
    """Baseline, axes, stitch radius and readout of two lenses.

    Args:
        found: estimates of the camera, those of its lenses' centres at least.
        known: covariances of these; None = one centre is as likely.
        scale: units of the result per map unit.
        settings: published baseline and readout time.
        timed: True if frames have times; else readout times in seconds are unknown.

    Returns:
        Content of report.json and notes. Lengths are in units of the result; `metres_per_unit`
        follows from the published baseline.
    """
    centres, radius, readout = found.centres, found.stitch_radius, found.readout
    assert centres is not None
    length, sigma = baseline_of(centres, scale)
    content = {
        "taken": bool(centres.lenses),
        "reason": centres.reason,
        "front_lens": scale * centres.found[:3],
        "front_lens_sigmas": scale * np.sqrt(np.diagonal(centres.covariance))[:3],
        "lens_centres": scale * all_centres(centres.found),
        "baseline": length,
        "baseline_sigma": sigma,
        "gain_of_unseen_parts": centres.part_gains,
    }
    notes, baseline = [], settings.baseline()
    if not centres.lenses:
        if baseline is not None:
            notes.append(f"two lenses were not found: no scale by the baseline: {centres.reason}")
        return content, notes
    which = "two" if centres.lenses.num_lenses == 2 else "first two"
    where = f"{length:.5g} map units apart (sigma {sigma:.1g})"
    if centres.reason:
        where = f"in one place ({where}), kept because rows are read one after another"
    notes.append(f"the {which} lenses are {where}")
    if baseline is not None:
        metres, of_metres = metres_per_unit((length, sigma), baseline)
        content |= {"metres_per_unit": metres, "metres_per_unit_sigma": of_metres}
        notes.append(
            f"one map unit is {metres:.4g} m (sigma {100 * of_metres / metres:.2g} %), if the "
            f"lenses are {1e3 * baseline[0]:g} mm apart"
        )
    if found.axes is not None:
        content["turned_below_panorama"] = centres.lenses.axes is not None
        content["gain_of_axes"] = found.axes.gains
        if centres.lenses.axes is not None:
            notes.append("the lenses rotate relative to the panoramas: a stabiliser was on")
    content["seam_band_deg"] = np.rad2deg(centres.lenses.band_rad)
    inverse_stitch_radius = centres.lenses.inverse_stitch_radius
    if radius is not None:
        deviation = radius.sigma
        if inverse_stitch_radius and known is not None:
            deviation = radius_sigma(inverse_stitch_radius, known.inverse_stitch_radius_sigma)
        content["stitch_radius"] = {
            "taken": not radius.reason,
            "reason": radius.reason,
            "inverse": (inverse_stitch_radius or radius.inverse_stitch_radius) / scale,
            "inverse_sigma": deviation / scale,
            "gain_of_unseen_parts": radius.part_gains,
        }
    if inverse_stitch_radius:
        notes.append(f"the stitch radius is {scale / inverse_stitch_radius:.3g} map units")
    if readout is not None:
        taken = readout.lenses.readout_motion is not None
        content["readout"] = {
            "taken": taken,
            "reason": readout.reason,
            "ms": 1e3 * readout.readout_s if timed else None,
            "ms_sigma": 1e3 * readout.readout_sigma if timed else None,
            "rows_run_along": readout.lenses.row_directions if taken else None,
            "gain_of_unseen_parts": readout.gains,
        }
        if timed:
            notes += _readout_notes(readout, settings)
        if readout.reason == TWO_INSTANTS:
            notes.append(f"{TWO_INSTANTS}: poses are between these, and less exact than they say")
    return content, notes


def of_lenses(found: FoundCamera, known: CameraSigmas | None) -> tuple[dict[str, Any], list[str]]:
    """Self-calibrated lenses of raw fisheyes; `known`: covariances of these, None = not computed.
    Returns content of report.json and notes."""
    lenses, voted = found.lenses, found.calibrated
    if lenses.fisheyes is None:
        reason = "" if voted is None else voted.reason
        return {"taken": False, "reason": reason}, []
    num = len(lenses.fisheyes)
    sigmas = np.full(num_parameters(num), np.nan)
    if known is not None and known.lens_sigmas is not None:
        sigmas = known.lens_sigmas
    content, notes = dict[str, Any](taken=True, reason=""), []
    names = lens_names(num)
    of_lens = np.split(sigmas, [first_of(lens) for lens in range(1, num)])
    for name, lens, own in zip(names, lenses.fisheyes, of_lens, strict=True):
        content[name] = {
            "focal": lens.focal,
            "focal_sigma": lens.focal * own[0],
            "principal": lens.principal,
            "principal_sigmas": lens.focal * own[1:3],
            "radial": lens.radial,
            "radial_sigmas": own[3:7],
        }
    for name, own in zip(names[1:], of_lens[1:], strict=True):
        content[name]["turn_sigmas_deg"] = np.rad2deg(own[7:])
    loose = undetermined(sigmas)
    content["hardly_determined"] = loose
    if loose:
        notes.append(
            f"these frames hardly determine some lens parameters: {', '.join(loose)} (they stay "
            "near their initial values)"
        )
    focals = " and ".join(f"{content[name]['focal']:.2f}" for name in names)
    spreads = " and ".join(f"{content[name]['focal_sigma']:.1g}" for name in names)
    notes.append(
        f"the lenses were self-calibrated: focal lengths {focals} pixels (sigmas {spreads}); for "
        "other runs of this camera use calibration.json"
    )
    return content, notes


def _readout_notes(found: CameraEstimate, settings: CameraSettings) -> list[str]:
    """Notes on the estimated readout time, and on its deviation from the published one."""
    if found.lenses.readout_motion is None:
        return []
    notes = [
        f"the readout time is {1e3 * found.readout_s:.1f} ms (sigma "
        f"{1e3 * found.readout_sigma:.1g}); poses account for the camera's motion in it"
    ]
    published = settings.readout()
    if published is not None:
        off = abs(found.readout_s - published[0])
        if off > 3.0 * np.hypot(found.readout_sigma, published[1]):
            notes.append(
                f"the settings give a readout time of {1e3 * published[0]:g} ms: check the name of "
                "the camera (--camera)"
            )
    return notes
