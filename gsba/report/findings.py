"""What a run found out: of its trajectory, its maps and its frames, in words and for the report."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsba.bundle.map_strength import scale_sigmas
from gsba.bundle.stitching import Stitching
from gsba.loop_closure.merged_map import Registered
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.joining import GUESS, SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, FrameSet, PoseSource, PoseStatus, Reconstruction

logger = logging.getLogger(__name__)

_NAMED = 5  # frames in a line of the log
_MANY = 0.1  # part of a trajectory's steps: contradicted, the rest of it is in doubt, too


def of_trajectory(
    trust: StepChecks,
    clock: ClockEstimate | None,
    merged: Registered | None,
    joints: tuple[SegmentAlignment, ...],
    frames: FrameSet,
    absent: bool = False,
) -> tuple[dict[str, Any], list[str]]:
    """What images say of the trajectory, for report.json, and what to note of it.

    Args:
        trust: its steps.
        clock: its clock; None = not checked.
        merged: parts of the map that were joined; None = it never was in parts.
        joints: how its pieces were joined.
        frames: of the run.
        absent: there is no trajectory: images contradict none of its frames and steps.
    """
    found, notes = _steps(trust, frames, absent)
    if clock is not None:
        found |= {"clock": _clock(clock)}
        if clock.verdict == "corrected":
            logger.warning(clock.note)
            notes.append(clock.note)
        elif clock.note:
            logger.info(clock.note)
    maps, more = _maps(merged, joints, frames)
    return found | maps, notes + more


def _steps(trust: StepChecks, frames: FrameSet, absent: bool) -> tuple[dict[str, Any], list[str]]:
    """The judgement by the names of frames, for the report, and what to note of it."""
    names = np.array(frames.names)

    def between(chosen: np.ndarray) -> list[Any]:
        return [[names[f], names[f + 1]] for f in np.flatnonzero(chosen).tolist()]

    false = [] if absent else names[trust.false_frames].tolist()
    judgement = {
        "false_frames": false,
        "false_steps": [] if absent else between(trust.false_steps),
        "unseen_steps": between(trust.unseen_steps),
    }
    notes = []
    if false:
        notes.append(f"the images contradict the trajectory at {', '.join(false)}: not believed")
    if trust.turning_only:
        notes.append("no frame has parallax to the next: no depth can be had, rotations only")
    if trust.held_steps.any():
        steps = ", ".join(f"{a} to {b}" for a, b in between(trust.held_steps))
        seen = ~trust.unseen_steps
        wrong, num = np.count_nonzero(trust.false_steps & seen), np.count_nonzero(seen)
        doubt = (
            f" (images contradict {wrong} of its other {num} steps)" if wrong > _MANY * num else ""
        )
        notes.append(f"no images in common, held by the trajectory alone{doubt}: {steps}")
    for note in notes:
        logger.warning(note)
    return judgement, notes


def _maps(
    registered: Registered | None, joints: tuple[SegmentAlignment, ...], frames: FrameSet
) -> tuple[dict[str, Any], list[str]]:
    """Pieces, maps and registered frames by their names, for the report, and what to note."""
    names, notes = np.array(frames.names), []
    pieces = [
        {
            "first": names[joint.first],
            "last": names[joint.last],
            "scale": joint.scale,
            "world_T_own": joint.world_T_own,
            "how": joint.how,
        }
        for joint in joints
    ]
    for joint in joints:
        told = f"joined by {joint.how}, scale {joint.scale:.4g}"
        if joint.how == GUESS:
            told = "no images tell how this piece lies to the others"
        notes.append(f"the trajectory begins anew at {names[joint.first]}: {told}")
    judgement: dict[str, Any] = {"joints": pieces} if pieces else {}
    if registered is None:
        return judgement, notes
    alone, lost = names[registered.alone].tolist(), names[registered.lost].tolist()
    own = registered.components[~registered.lost]
    maps = [names[registered.components == c].tolist() for c in np.unique(own)]
    count = len(maps)
    judgement |= {"registered": alone, "not_registered": lost}
    judgement["maps"] = maps if count > 1 else []
    if alone:
        notes.append(f"registered against the map: {', '.join(alone)}")
    if lost:
        notes.append(f"could not be registered, not exported: {', '.join(lost)}")
    if count > 1:
        parts = "; ".join(
            f"map {n} from {m[0]} to {m[-1]} ({len(m)} frames)" for n, m in enumerate(maps[1:], 2)
        )
        notes.append(
            f"nothing ties {count} places together: each is a map of its own, and map 1 with its "
            f"{len(maps[0])} frames is exported; the others are in poses.csv, and are exported by "
            f"gsba export --map NUMBER: {parts}"
        )
    return judgement, notes


def _clock(estimate: ClockEstimate) -> dict[str, Any]:
    """The estimate for the report: seconds, and degrees of a step's rotation."""
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
    """What report.json says of a field that stitching bends."""
    field = found.field
    rays = np.random.default_rng(0).normal(size=(2000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
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
) -> list[str]:
    """What the user should know about a run; warnings of the log name few frames of many.

    Args:
        frame_weights: (F,) of each frame's pixels, below 1 where they contradict the others.
        max_scale_sigma: of a step's length over the one before it; above, a place is named.
    """
    absent = coarse.sources == PoseSource.NONE
    filled = np.flatnonzero((coarse.sources != PoseSource.SLAM) & ~absent)
    unrefined = reconstruction.pose_statuses == PoseStatus.UNREFINED
    lost = np.flatnonzero(unrefined & (reconstruction.map_numbers() > 0))
    doubted = np.flatnonzero(frame_weights < 1)
    weak = _weak_places(reconstruction, max_scale_sigma)
    uncertain = (
        f"the scale is uncertain by more than {max_scale_sigma:.2%} where few points are seen from "
        "three frames"
    )
    notes = []
    if absent.all():
        notes.append("no trajectory: started from the images alone, in units of their own")
    if coarse.time_offset:
        notes.append(f"frame times were shifted by {coarse.time_offset:.6f} s")
    for note in notes:
        logger.warning(note)
    fetched = (
        "frames of the video that were fetched where the map was weak, left out of datasets unless "
        "export.fetched = true"
    )
    for what, rows in (
        (fetched, np.flatnonzero(frames.fetched)),
        ("no SLAM pose, started between neighbours", filled),
        ("no matches, the pose comes from the trajectory", lost),
        ("pixels fit badly and were weighted down", doubted),
        (uncertain, weak),
    ):
        if len(rows):
            names = [frames.names[f] for f in rows]
            notes.append(f"{what}: {', '.join(names)}")
            logger.warning("%s: %s", what, _brief(names, len(frames)))
    return notes


def _weak_places(reconstruction: Reconstruction, max_scale_sigma: float) -> np.ndarray:
    """Frames at which images hand the scale on poorly, even after a closer look."""
    poses, joint = reconstruction.world_T_rigs, reconstruction.joint_errors
    if joint is None or len(poses) < 3:
        return np.zeros(0, np.intp)
    return 1 + np.flatnonzero(scale_sigmas(poses, joint.draws) > max_scale_sigma)


def _brief(names: Sequence[str], num_frames: int) -> str:
    """The names of a few frames; of more, how many they are and where all are listed."""
    if len(names) <= _NAMED:
        return ", ".join(names)
    return f"{len(names)} of {num_frames} frames, listed in report.json"
