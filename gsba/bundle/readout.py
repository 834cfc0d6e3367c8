"""Motion during the readout of a frame: whether rows are read one after another, and which way.
`camera_adjustment` then finds each frame's own motion."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product

import numpy as np

from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.shared_parameters import (
    PARTS,
    ObservedRays,
    Weighted,
    cross_validate,
    frame_models,
    frame_step,
    models_of,
    newton_step,
    predicts,
    summed,
    validated,
)
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses, rows_run
from gsba.config import CameraSettings
from gsba.geometry import frames_beside
from gsba.types import Counts, GyroConstraints, Tracks

logger = logging.getLogger(__name__)

_MIN_SIGMAS = 4.0  # least duration that is taken, in its standard deviations
LIKELY = 0.016, 0.008  # s, readout time of a video's frame, and its standard deviation
VANISHED = "it vanishes where each frame's own motion is adjusted beside it"
_OTHER_WAY = "rows are read the other way than camera.sweep says"
TWO_INSTANTS = "the lenses may as well have taken their pictures at two instants"
_AXES = np.eye(3)[:2]


@dataclass(frozen=True, slots=True)
class CameraEstimate:
    """Estimate of a camera: its lenses, readout time, and motion of frames during the readout."""

    lenses: Lenses  # with row_directions and readout_motion, if they were taken
    readout_s: float = float("nan")  # readout time from the first to the last row; NaN = not known
    readout_sigma: float = float("nan")
    own_sigmas: np.ndarray | None = None  # (6,) float64, estimated spread of frames' motion about
    # their velocity, [rotation rad, translation map units]; None = not estimated yet
    gains: np.ndarray = field(default_factory=lambda: np.full(PARTS, np.nan))  # (PARTS,) float64,
    # share of the robust cost of each part that the duration of the other parts removes
    reason: str = ""  # why no readout was taken; empty if one was
    by_gyro: bool | None = None  # whether rotations are held to a gyro's; None = there is none
    counts: Counts = field(default_factory=lambda: Counts(0, 0, "observations"))
    of_few_frames: bool = False  # whether it was found by each frame's own motion: the readout time
    # is about a likely one

    def scaled(self, scale: float) -> "CameraEstimate":
        """The estimate in another unit of length: one map unit is `scale` of the new ones."""
        own = self.own_sigmas
        own = own if own is None else own * np.repeat([1.0, scale], 3)
        return replace(self, lenses=self.lenses.scaled(scale), own_sigmas=own)


def estimate(rays: ObservedRays, few_frames: bool = False) -> CameraEstimate:
    """Find how long the readout takes and which way rows are read, frames moving by velocity; no
    readout is taken while another way of reading rows predicts unseen parts nearly as well. Lenses
    are read at one instant so far; directions in the pictures tell rows. few_frames: judge frames
    too few for parts of the sequence by each frame's own motion."""
    solved, keypoints, shown, lenses = rays.solved, rays.keypoints, rays.shown, rays.lenses
    landmarks, context = solved.landmarks, rays.context
    turning = turning_of(lenses, context)
    motion = velocities(solved.world_T_rigs, rays.timestamps, turning, context.maps)
    offsets = None
    if motion[:, :3].any():  # points in the rig frames of the keypoints that see them; 0 = none
        tracks, offsets = landmarks.tracks, np.zeros((len(keypoints.faces), 3))
        poses = solved.world_T_rigs[tracks.frames]
        from_rigs = landmarks.points_world[tracks.points] - poses[:, :3, 3]
        offsets[keypoints.rows(tracks)] = np.einsum("oji,oj->oi", poses[:, :3, :3], from_rigs)
    ways, frames = _ways(context.settings.camera, lenses), keypoints.frames()

    def by_duration(rows: np.ndarray, by_origin: np.ndarray, _: np.ndarray) -> np.ndarray:
        directions, there = shown[rows], frames[rows]
        times = np.stack([lenses.fractions(directions, there, way) for way in ways], axis=1)
        moving = motion[there, 3:]
        if offsets is not None:  # a turning ray's point moves as if it were carried along
            moving = moving + np.cross(motion[there, :3], offsets[rows])
        moved = np.einsum("oij,oj->oi", by_origin, moving)
        return moved[:, :, None] * times[:, None, :]

    systems, counts = models_of(rays, by_duration)
    if not systems and few_frames:
        return _of_few_frames(rays, ways, motion, counts)
    if not systems:
        return CameraEstimate(lenses, reason="too few points to tell rows apart", counts=counts)
    of_ways = [[part.of(slice(way, way + 1)) for part in systems] for way in range(len(ways))]
    durations = partial(newton_step, curved=False)  # (1,) by some parts
    verdicts = [cross_validate(parts, durations) for parts in of_ways]
    best = int(np.argmax([verdict.gains.sum() for verdict in verdicts]))
    total = summed(of_ways[best])
    curved = max(float(total.hessian[0, 0]), 1e-300)
    verdict, sigma = verdicts[best], (total.curvature * curved) ** -0.5
    duration = -float(total.gradient[0]) / curved / total.curvature
    sign = -1.0 if duration < 0 else 1.0  # rows are read the other way
    found = CameraEstimate(lenses, abs(duration), sigma, gains=verdict.shares, counts=counts)
    logger.debug("readout: %.2f ms (sigma %.2f)", 1e3 * abs(duration), 1e3 * sigma)
    if not verdict.predicts or abs(duration) < _MIN_SIGMAS * sigma:
        return replace(found, reason="motion during the readout does not predict unseen parts")
    others = [other for way, other in enumerate(verdicts) if way != best]
    if not all(predicts(verdict.gains - other.gains) for other in others):
        return replace(found, reason="rows may be read in other directions as well")
    if duration < 0 and _said_way(context.settings.camera, lenses) is not None:
        return replace(found, reason=_OTHER_WAY)
    readout_motion = abs(duration) * motion
    return replace(
        found,
        lenses=replace(lenses, row_directions=sign * ways[best], readout_motion=readout_motion),
    )


def _of_few_frames(
    rays: ObservedRays, ways: Sequence[np.ndarray], velocity: np.ndarray, counts: Counts
) -> CameraEstimate:
    """Readout of raw frames too few for parts of the sequence: each frame's own motion during it,
    found from some points, has to predict the other points, better than any other way of reading
    rows does, and better than lenses that take their pictures at two instants.

    Motion that all frames share is no evidence: a lens that is modelled roughly looks like it.
    """
    lenses, shown, frames = rays.lenses, rays.shown, rays.keypoints.frames()
    said = rays.context.settings.camera.readout() or LIKELY
    found = CameraEstimate(lenses, *said, counts=counts, of_few_frames=True)
    sigmas = own_sigmas(found, velocity)
    times = [lenses.fractions(shown, frames, way) for way in ways]
    times.append(0.5 - lenses.facing(shown, frames) / (lenses.num_lenses - 1))  # two instants

    def moved(times: np.ndarray, seen: Weighted) -> np.ndarray:
        return times[seen.rows, None, None] * seen.by_pose

    models = [frame_models(rays.drawn, partial(moved, each)) for each in times]
    verdicts = [validated(model, sigmas, alike=True) for model in models]
    gains = [verdict.gains for verdict in verdicts]
    best = int(np.argmax([gain.sum() for gain in gains]))
    logger.debug("readout of few frames: gains %s", [round(float(gain.sum()), 1) for gain in gains])
    left, reason = [predicts(gains[best] - gain) for gain in gains], ""
    if not verdicts[best].predicts:
        reason = "motion during the readout does not predict unseen points"
    elif not left[-1]:
        reason = TWO_INSTANTS
    elif not all(left[:best] + left[best + 1 :]):
        reason = "rows may be read in other directions as well"
    if reason:
        return CameraEstimate(lenses, gains=verdicts[best].shares, reason=reason, counts=counts)
    own = frame_step(models[best], sigmas).reshape(len(velocity), -1)[:, 6:]
    # Rows read the other way, and the reversed motion, show the same: frames move by their velocity
    sign = -1.0 if np.sum(own[:, 3:] * velocity[:, 3:]) < 0 else 1.0
    if sign < 0 and _said_way(rays.context.settings.camera, lenses) is not None:
        return CameraEstimate(lenses, gains=verdicts[best].shares, reason=_OTHER_WAY, counts=counts)
    taken = replace(lenses, row_directions=sign * ways[best], readout_motion=sign * own)
    return replace(found, lenses=taken, gains=verdicts[best].shares)


def without_vanished(found: CameraEstimate) -> CameraEstimate:
    """The adjusted estimate, read at one instant if little is left of the duration that was taken.

    Seams that optical flow has aligned look like motion along the velocity, until each frame moves
    as it likes.
    """
    if (
        found.lenses.readout_motion is None
        or found.of_few_frames
        or not (found.readout_s < _MIN_SIGMAS * found.readout_sigma)
    ):
        return found
    lenses = replace(found.lenses, row_directions=None, readout_motion=None)
    return replace(found, lenses=lenses, own_sigmas=None, reason=VANISHED)


def total_sigma(found: CameraEstimate, sigma: float) -> float:
    """Standard deviation of the duration, seconds, by the covariance of the adjustment, in which
    rows are known exactly, and with that of the scale of rows."""
    # 3 %: the distortion and field of view of lenses, which give the number of rows between two
    # directions, are not known from a stitched picture
    scale_sigma = 0.0 if found.lenses.reference_calibration is not None else 0.03
    return float(np.hypot(sigma, scale_sigma * found.readout_s))


def own_sigmas(found: CameraEstimate, motion: np.ndarray) -> np.ndarray:
    """Standard deviations (6,) of frames' motion during readout about their velocities (F, 6)."""
    if found.own_sigmas is not None:
        return found.own_sigmas
    likely = found.readout_s * np.linalg.norm(motion[:, 3:], axis=1)
    move = max(0.3 * float(np.median(likely)), 1e-12)  # about that by the velocity
    # about each axis; from axes of their own, a stabiliser has removed rotations
    turn = np.deg2rad(0.12 if found.lenses.axes is None else 0.005)
    return np.repeat([turn, move], 3)


def turning_of(lenses: Lenses, context: AdjustmentContext) -> GyroConstraints | None:
    """Rotation rates of the frames by a gyro; None where a stabiliser has removed rotations."""
    return None if lenses.axes is not None else context.turning


def velocities(
    world_T_rigs: np.ndarray,
    timestamps: np.ndarray,
    turning: GyroConstraints | None = None,
    maps: np.ndarray | None = None,
) -> np.ndarray:
    """Mean velocity (F, 6) around each frame, [rotation rad/s, translation per s], rig frame, of
    poses (F, 4, 4) at ascending timestamps (F,), seconds, in maps (F,), None = there is one.

    Between frames a walk turns to and fro: rotations say nothing of those during a readout, which
    are 0 where no gyro knows them. Nothing is known of motion across a pause, such as that from one
    recording to the next, nor from one map to another, whose worlds nothing relates.
    """
    intervals = np.diff(timestamps)
    breaks = intervals > 50.0 * np.median(intervals)
    if maps is not None:
        breaks |= maps[1:] != maps[:-1]
    before, after = frames_beside(breaks)
    span = np.maximum(timestamps[after] - timestamps[before], intervals.min())[:, None]
    moved = world_T_rigs[after, :3, 3] - world_T_rigs[before, :3, 3]
    local = np.einsum("fji,fj->fi", world_T_rigs[:, :3, :3], moved)
    rates = np.zeros_like(local) if turning is None else np.nan_to_num(turning.rates)
    return np.hstack([rates, local / span])


def _said_way(camera: CameraSettings, lenses: Lenses) -> np.ndarray | None:
    """Row directions (2, 3) that settings name; None = they name none of these lenses."""
    if camera.sweep is None or lenses.num_lenses != len(camera.sweep):
        return None
    named = {"+x": _AXES[0], "-x": -_AXES[0], "+y": _AXES[1], "-y": -_AXES[1]}
    return np.array([named[way] for way in camera.sweep])


def _ways(camera: CameraSettings, lenses: Lenses) -> list[np.ndarray]:
    """Row directions (L, 3) that lenses may have, up to all of them reversed."""
    num, said = lenses.num_lenses, _said_way(camera, lenses)
    if said is not None:
        return [said]
    signs = [np.array([[1.0, *rest]]).T for rest in product((1.0, -1.0), repeat=num - 1)]
    if lenses.reference_calibration is not None:
        down = rows_run(lenses.reference_calibration)
        return [sign * down for sign in signs]
    if camera.lens_yaws_deg is not None:  # of one make: all read along their own right or down
        down = np.tile(_AXES[1], (num, 1))
        right = np.cross(down, lenses.optical_axes)
        return [sign * axes for axes in (right, down) for sign in signs]
    back = [sign * axis for axis in _AXES for sign in (1.0, -1.0)]
    return [np.array(way) for way in product(_AXES, back)]


@dataclass(frozen=True, slots=True)
class CameraEstimates:
    """Estimate of each camera, and the camera of each frame."""

    each: tuple[CameraEstimate, ...]  # (C,)
    of_frame: tuple[int, ...] = ()  # (F,) as in `Cameras`

    @property
    def cameras(self) -> Cameras:
        """The lenses of each camera."""
        return Cameras(tuple(one.lenses for one in self.each), self.of_frame)

    def with_each(self, each: Sequence[CameraEstimate]) -> "CameraEstimates":
        """Other estimates (C,) of the cameras that took these frames."""
        if len(each) != len(self.each):
            raise ValueError(f"estimates of {len(each)} cameras instead of {len(self.each)}")
        return replace(self, each=tuple(each))

    def changed(self, camera: int, found: CameraEstimate) -> "CameraEstimates":
        """The estimates with another one of one camera."""
        return self.with_each([*self.each[:camera], found, *self.each[camera + 1 :]])

    def frames_of(self, camera: int, num_frames: int) -> np.ndarray:
        """Frames (F',) int64 that a camera took, of `num_frames`."""
        return self.cameras.frames_of(camera, num_frames)


def tracks_of_camera(tracks: Tracks, of_frame: Sequence[int], camera: int) -> Tracks:
    """Tracks of what one camera observes: points that it sees twice or more; of_frame: (F,) camera
    of each frame, () = there is one."""
    if not of_frame:
        return tracks
    own = np.array(of_frame)[tracks.frames] == camera
    return tracks.of_observations(tracks.seen_twice(own))
