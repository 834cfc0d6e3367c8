"""Findings on a run's trajectory, maps and frames, for report.json, and notes for the user."""

import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsba.bundle.gps_factors import MIN_FIXES
from gsba.bundle.map_strength import scale_sigmas
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.stitching import Stitching
from gsba.geometry import unit
from gsba.imu.alignment import Alignment
from gsba.loop_closure.merged_map import Registered
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import GUESS, SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, FrameSet, PoseSource, PoseStatus, Reconstruction, RunStart

logger = logging.getLogger(__name__)


def of_trajectory(
    trust: StepChecks,
    clock: ClockEstimate | None,
    merged: Registered | None,
    joints: tuple[SegmentAlignment, ...],
    frames: FrameSet,
    unguided: np.ndarray | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """Checks of the trajectory by images, for report.json, and notes.

    Args:
        clock: its clock; None = not checked.
        merged: parts of the map that were joined; None = the map never was in parts.
        unguided: (F,) bool, frames of recordings without a trajectory, of which images contradict
            no step; None = all have one.
    """
    found, notes = _steps(trust, frames, unguided)
    if clock is not None:
        found |= {"clock": clock_section(clock)}
        if clock.verdict == "corrected":
            logger.warning(clock.note)
            notes.append(clock.note)
        elif clock.note:
            logger.info(clock.note)
    maps, more = _maps(merged, joints, frames)
    return found | maps, notes + more


def _steps(
    trust: StepChecks, frames: FrameSet, unguided: np.ndarray | None
) -> tuple[dict[str, Any], list[str]]:
    """Contradicted, unseen and held steps by the names of their frames, for the report, and
    notes."""
    names, owners = np.array(frames.names), frames.recording_of_frame
    given = np.ones(len(names), bool) if unguided is None else ~unguided
    inside = owners[1:] == owners[:-1]  # not from one recording to the next

    def between(chosen: np.ndarray) -> list[Any]:
        return [[names[f], names[f + 1]] for f in np.flatnonzero(chosen).tolist()]

    false = names[trust.false_frames & given].tolist()
    judgement = {
        "false_frames": false,
        "false_steps": between(trust.false_steps & inside & given[1:] & given[:-1]),
        "unseen_steps": between(trust.unseen_steps & inside),
        "held_steps": between(trust.held_steps),
    }
    notes = []
    if false:
        notes.append(
            f"images contradict the trajectory at {named(false, 'trajectory.false_frames')}: its "
            "poses there are not used"
        )
    if trust.turn is not None:
        notes.append(
            "matches show a turn on the spot and no parallax: only rotations are refined, and "
            "there are no points"
        )
        judgement["not_tied"] = apart = names[~trust.turn.frames].tolist()
        if apart:
            notes.append(
                "no matches tie these frames to the others: they have no rotation and are not "
                f"exported: {named(apart, 'trajectory.not_tied', f'of {len(names)} frames')}"
            )
    for note in notes:
        logger.warning(note)
    return judgement, notes


def _maps(
    registered: Registered | None, joints: tuple[SegmentAlignment, ...], frames: FrameSet
) -> tuple[dict[str, Any], list[str]]:
    """Pieces, maps and registered frames by their names, for the report, and notes."""
    names, notes = np.array(frames.names), []
    pieces = [
        {
            "first": names[joint.first],
            "last": names[joint.last],
            "scale": joint.scale,
            "world_T_own": joint.world_T_own,
            "how": joint.how,
        }
        | ({} if joint.covariance is None else {"covariance": joint.covariance})
        for joint in joints
    ]
    for joint in joints:
        first, before = names[joint.first], names[joint.first - 1]
        piece, begin = "piece", f"a new piece of the trajectory begins at {first}"
        if first.rpartition("/")[0] != before.rpartition("/")[0]:
            piece, begin = "recording", f"recording {first.rpartition('/')[0]}"
        alignment = f"joined by {joint.how}, scale {joint.scale:.4g}"
        if joint.covariance is not None:
            sigma = 100 * float(np.sqrt(joint.covariance[6, 6]))
            alignment += f" (sigma {f'{sigma:.2g} %' if np.isfinite(sigma) else 'not known'})"
        if joint.how == GUESS:
            alignment = f"no images show how this {piece} is aligned to the others"
        notes.append(f"{begin}: {alignment}")
    judgement: dict[str, Any] = {"joints": pieces} if pieces else {}
    if registered is None:
        return judgement, notes
    alone, lost = names[registered.alone].tolist(), names[registered.lost].tolist()
    own = registered.components[~registered.lost]
    maps = [names[registered.components == c].tolist() for c in np.unique(own)]
    judgement |= {"registered": alone, "not_registered": lost}
    judgement["maps"] = maps if len(maps) > 1 else []
    if alone:
        notes.append(
            f"{len(alone)} frames were registered against the map's points: "
            f"{named(alone, 'trajectory.registered')}"
        )
    return judgement, notes


def clock_section(estimate: ClockEstimate) -> dict[str, Any]:
    """Clock estimate for the report: seconds, and degrees of a step's rotation."""
    return {
        "verdict": estimate.verdict,
        "offset_s": estimate.clock.offset,
        "rate": estimate.clock.rate,
        "found_offset_s": estimate.found.offset,
        "offset_sigma_s": estimate.offset_sigma,
        "found_rate": estimate.found.rate,
        "rate_sigma": estimate.rate_sigma,
        "disagreement_given_deg": estimate.before_deg,
        "disagreement_found_deg": estimate.after_deg,
        "note": estimate.note,
    }


def of_field(found: Stitching) -> dict[str, Any]:
    """Content of report.json on the stitching field."""
    field = found.field
    rays = unit(np.random.default_rng(0).normal(size=(2000, 3)))
    largest = np.linalg.norm(field.displacements(rays), axis=1).max()
    return {
        "taken": bool(field),
        "degree": found.degree,
        "rms_deg": np.rad2deg(field.rms_rad),
        "max_deg": np.rad2deg(largest),
        "gain_of_unseen_parts": found.part_gains,
        "coefficients_rad": field.coefficients,
    }


def of_frames(
    frames: FrameSet,
    coarse: CoarsePoses,
    reconstruction: Reconstruction,
    frame_weights: np.ndarray,
    max_scale_sigma: float,
    start: str = RunStart.TRAJECTORY,
) -> tuple[dict[str, list[str]], list[str]]:
    """Names of frames with a finding, for `frame_lists` of report.json, and notes.

    Args:
        frame_weights: (F,) weight of each frame's pixels, below 1 if they contradict the others.
        max_scale_sigma: relative sigma of the ratio of two successive baselines; frames above it
            are listed.
    """
    absent = coarse.sources == PoseSource.NONE
    filled = np.flatnonzero((coarse.sources != PoseSource.SLAM) & ~absent)
    unrefined = reconstruction.pose_statuses == PoseStatus.UNREFINED
    lost = np.flatnonzero(unrefined & (reconstruction.map_numbers() > 0))
    doubted = np.flatnonzero(frame_weights < 1)
    poses, joint, weak = reconstruction.world_T_rigs, reconstruction.joint_errors, np.zeros(0, int)
    if joint is not None and len(poses) >= 3:
        weak = 1 + np.flatnonzero(scale_sigmas(poses, joint.draws) > max_scale_sigma)
    notes = []
    if absent.all():
        notes.append("started from pairs of frames: the unit of the map is arbitrary")
    untimed = np.count_nonzero(absent & ~frames.timed_frames)
    if absent.all() and untimed:
        some = f"{untimed} of {len(absent)} " if untimed < len(absent) else ""
        notes.append(
            f"{some}frames have no times: unless poses.csv lists them in the order of the way, a "
            "place that repeats makes a wrong map"
        )
    if coarse.time_offset:
        notes.append(f"frame times were shifted by {coarse.time_offset:.6f} s")
    fetched = (
        "extra frames of the video strengthened the map; datasets skip them, --set "
        "export.fetched=true keeps them"
    )
    lists = {}
    for key, finding, rows in (
        ("fetched", fetched, np.flatnonzero(frames.fetched)),
        ("interpolated", f"no pose of the {start}, the initial pose is interpolated", filled),
        ("unmatched", "", lost),  # a reason of the verdict
        ("weighted_down", "pixels fit badly and were weighted down", doubted),
        ("uncertain_scale", "", weak),  # a figure: it holds for most frames of good maps, too
    ):
        lists[key] = names = [frames.names[f] for f in rows]
        if names and finding:
            unit = f"of {len(frames)} frames"
            notes.append(f"{finding}: {named(names, f'frame_lists.{key}', unit)}")
    for note in notes:
        logger.info(note)
    return lists, notes


def named(names: Sequence[str], key: str, unit: str = "frames") -> str:
    """Names of a few frames or steps; of more, their number and the key in report.json."""
    if len(names) <= 5:  # frames whose names a note lists
        return ", ".join(names)
    return f"{len(names)} {unit}, listed in report.json under {key}"


def notes_on_gps(content: Mapping[str, Any], num_frames: int) -> list[str]:
    """Notes on used and false fixes; content: report of the family, see
    `gsba.bundle.gps_factors.GpsFactors.report`."""
    if not content["taken"]:
        why = (
            "most of them are further from where the images put the frames than their noise and a "
            "map's drift allow, or the path is shorter than their error"
        )
        if content["contradicted"]:
            why = "they would bend the map by more than its images and their noise allow"
        note = (
            f"GPS was not used: the images contradict its {content['fixes']} positions: {why}; "
            "check the positions, their noise and their clock"
        )
        if content["too_few_in_each_map"]:
            note = (
                f"GPS was not used: frames came out in maps of which none has {MIN_FIXES} of the "
                f"{content['fixes']} positions"
            )
        logger.warning(note)
        return [note]
    typical, claimed = content["rms_m_east_north_up"], content["sigma_m_east_north_up"][0]
    across, false = math.hypot(typical[0], typical[1]), content["false_fixes"]
    note = (
        f"GPS held {content['used']} of {num_frames} frames: residuals are {across:.2g} m "
        f"horizontally and {typical[2]:.2g} m vertically (rms; the assumed sigma is {claimed:.2g} "
        "m per axis)"
    )
    if content["fixes_elsewhere"]:
        note += f"; {content['fixes_elsewhere']} positions are of maps that they do not place"
    if false:
        note += f"; {len(false)} fixes are outliers: {named(false, 'gps.false_fixes')}"
    return [note]


def of_gyro(
    found: Alignment, steps_used: float | None, readout: CameraEstimate | None
) -> tuple[dict[str, Any], list[str]]:
    """Clock, bias and axes of a gyro, and the share of its steps that agree with the poses.

    Args:
        steps_used: share of its steps that agree with the poses; None = it was not used.
        readout: estimated readout of the frames; None = a global shutter.

    Returns:
        Content of report.json and notes.
    """
    content: dict[str, Any] = {
        "taken": steps_used is not None,
        "reason": found.reason,
        "offset_s": found.clock.offset,
        "offset_sigma_s": found.offset_sigma,
        "rate": found.clock.rate,
        "bias_deg_per_s": np.rad2deg(found.sensor.bias),
        "scales": found.sensor.scales,
        "rig_R_imu": found.rig_R_imu,
        "axes_sigma_deg": np.rad2deg(found.axes_sigma),
        "noise_of_a_step_deg": np.rad2deg(found.noise),
        "turns_explained": found.explained,
    }
    if steps_used is None:
        note = f"the gyro was not used: {found.reason}"
        logger.warning(note)
        return content, [note]
    during = (
        None if readout is None or readout.lenses.readout_motion is None else bool(readout.by_gyro)
    )
    content |= {"steps_used": steps_used, "during_readout": during}
    bias = ", ".join(f"{value:.3g}" for value in np.rad2deg(found.sensor.bias))
    notes = [
        f"the gyro agrees with {100 * steps_used:.0f} % of the steps between frames (sigma "
        f"{np.rad2deg(found.noise):.2g} degrees); its clock is {found.clock.offset:.4f} s ahead "
        f"(sigma {found.offset_sigma:.1g}), its bias is {bias} degrees per second, and the sigma "
        f"of its axes is {np.rad2deg(found.axes_sigma):.2g} degrees"
    ]
    if during is not None:
        source = "the gyro" if during else "images, which contradict the gyro"
        notes.append(f"rotations during the readout come from {source}")
    return content, notes


def of_recordings(
    frames: FrameSet,
    reconstruction: Reconstruction,
    sources: np.ndarray,
    clocks: Sequence[ClockEstimate | None],
) -> list[dict[str, Any]]:
    """Content of report.json on each of several recordings, in order; [] if there is only one.

    Args:
        sources: (F,) `PoseSource` of the frames' initial poses.
        clocks: clock of each recording's trajectory; None = not checked.
    """
    found, numbers = [], reconstruction.map_numbers()
    for (name, rows), clock in zip(frames.recordings.items(), clocks, strict=True):
        of_maps = np.bincount(numbers[rows])
        own = {
            "name": name,
            "frames": len(rows),
            "with_trajectory": bool((sources[rows] != PoseSource.NONE).any()),
            "frames_of_maps": {n: count for n, count in enumerate(of_maps.tolist()) if n and count},
            "frames_in_no_map": int(np.count_nonzero(numbers[rows] == 0)),
            "first": float(frames.timestamps[rows[0]]),
            "clock_shift_s": frames.clock_shifts[int(rows[0])],
            "timed": bool(frames.timed_frames[rows].all()),
        }
        found.append(own if clock is None else own | {"clock": clock_section(clock)})
    return found


def notes_on_recordings(recordings: Sequence[dict[str, Any]]) -> list[str]:
    """A sentence on each recording of which no frame is in the exported map."""
    notes = []
    for one in recordings:
        maps = one["frames_of_maps"]
        if 1 in maps:
            continue
        where = "in no map"
        if maps:
            largest = max(maps, key=maps.__getitem__)
            where = f"map {largest} with a world and scale of its own"
        notes.append(
            f"recording {one['name']} is not joined to the exported map: {where}; recordings are "
            "joined where they show the same place"
        )
    return notes
