"""Odometry of a whole sequence: poses, statuses, covariances, and the report."""

import logging
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np

from gsba import __version__
from gsba.config import OdometrySettings
from gsba.disk import write_csv, write_json
from gsba.geometry import inverse, quaternion_from_rotation, rotation_angle
from gsba.log import GsbaError, event, track
from gsba.odometry.closing import ClosedKeyframes, TrackedKeyframes, close
from gsba.odometry.panoramas import SmallPanoramas
from gsba.odometry.pose_graph import carried_covariances
from gsba.odometry.tracker import Tracker
from gsba.odometry.tracker_state import FrameStatus, TrackerState
from gsba.store.records import load_checkpoint, save_record
from gsba.store.shards import Threads, content_digest
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory
from gsba.video.likeness import sharpness

_PATIENCE_S, _MIN_PATIENCE = 1.5, 8  # seconds, and frames, before a lost camera begins a new map
_CHECKPOINT_S = 60.0  # between checkpoints
_MAX_SAVING_SHARE = 0.03  # of the time between checkpoints that writing one may take


@dataclass(slots=True)
class Tracking:
    """A sequence as far as it was tracked."""

    state: TrackerState = field(default_factory=TrackerState)
    rows: list[int] = field(default_factory=list)  # panoramas that could be read
    sharpness: list[float] = field(default_factory=list)  # of each; see gsba.video.likeness
    pictures: list[np.ndarray] = field(default_factory=list)  # (n,) uint8 each, keyframes as JPEG
    cpu_s: float = 0.0  # processor time, decoding apart


def track_frames(panoramas: SmallPanoramas, seed: int, checkpoint: Path | None) -> Tracking:
    """Pose all frames of a sequence in time order; damaged ones are left out. A checkpoint is
    written each minute; where it is of these panoramas, tracking goes on from it. The caller
    removes it. GsbaError: the disk refuses a checkpoint."""
    num, interval = len(panoramas), float(np.median(np.diff(panoramas.timestamps)))
    patience = max(_MIN_PATIENCE, round(_PATIENCE_S / interval))
    key = _key(panoramas, seed, patience) if checkpoint is not None else ""
    found = load_checkpoint(checkpoint, key, Tracking, "tracking begins anew") or Tracking()
    if found.rows:
        logger.info("tracking goes on after %d frames, from %s", len(found.rows), checkpoint)
    state, first = found.state, found.rows[-1] + 1 if found.rows else 0
    tracker = Tracker(panoramas.width, panoramas.usable, seed, patience, state)
    gone, due = _DistanceGone(state), time.monotonic() + _CHECKPOINT_S
    for number in range(len(state.keyframe_poses)):
        _tell_keyframe(state, number)
    pictures = panoramas.read(range(first, num), False)
    for row, grey in track(pictures, "tracking", num, first, gone):
        began = time.thread_time()
        tracker.add(grey)
        found.sharpness.append(sharpness(grey))
        found.rows.append(row)
        while len(state.keyframe_frames) > len(found.pictures):
            picture = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 90])[1]
            found.pictures.append(np.asarray(picture))  # some tens of kilobytes
            _tell_keyframe(state, len(found.pictures) - 1)
        found.cpu_s += time.thread_time() - began
        if checkpoint is not None and (began := time.monotonic()) > due:
            save_record(checkpoint, found, {"key": key})
            now = time.monotonic()
            due = now + max(_CHECKPOINT_S, (now - began) / _MAX_SAVING_SHARE)
    return found


def _tell_keyframe(state: TrackerState, number: int) -> None:
    """Pass a keyframe on as an event: its map, its position, some of the points that it sees."""
    ids, _ = state.keyframe_features[number]
    points = state.points[ids]
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, -(-len(points) // 12))]  # a dozen at most
    position = state.keyframe_poses[number][:3, 3]
    map_number = state.records[state.keyframe_frames[number]].map_number
    told = {"position": position.round(4).tolist(), "points": points.round(4).tolist()}
    event("keyframe", map=map_number, **told)


@dataclass(slots=True)
class _DistanceGone:
    """Length of the path so far, for the progress bar; from one map to the next there is none."""

    state: TrackerState
    keyframes: int = 1  # that are counted
    length: float = 0.0  # map units

    def __call__(self) -> str:
        state, poses = self.state, self.state.keyframe_poses
        for n in range(self.keyframes, len(poses)):
            ends = state.keyframe_frames[n - 1 : n + 1]
            if len({state.records[f].map_number for f in ends}) == 1:
                self.length += float(np.linalg.norm(poses[n][:3, 3] - poses[n - 1][:3, 3]))
        self.keyframes = max(len(poses), 1)
        return f"{self.length:.1f} units gone"


def _key(panoramas: SmallPanoramas, seed: int, patience: int) -> str:
    """Digest of all that tracking rests on."""
    usable = np.ones(0, bool) if panoramas.usable is None else panoramas.usable
    what = panoramas.width, seed, patience, __version__
    return content_digest(panoramas.contents, panoramas.timestamps, usable, what)


logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Frames in a row."""

    first_s: float  # seconds, time of the first
    last_s: float  # seconds, time of the last
    frames: int


@dataclass(frozen=True, slots=True)
class Odometry:
    """Poses of the camera during a sequence; each map has a world and a unit of its own."""

    timestamps: np.ndarray  # (F,) float64, seconds
    world_T_rigs: np.ndarray  # (F, 4, 4) float64, world of each frame's map
    statuses: np.ndarray  # (F,) uint8, FrameStatus
    maps: np.ndarray  # (F,) int32, 0 = the first map
    keyframes: np.ndarray  # (F,) bool
    distances: np.ndarray  # (F,) float64, median distance of points, map units; NaN = not known
    inliers: np.ndarray  # (F,) int32, features that fit the pose
    sharpness: np.ndarray  # (F,) float64, of the small picture; see gsba.video.likeness
    cpu_s: float  # processor time of tracking, without decoding
    covariances: np.ndarray | None = None  # (F, 6, 6) float64, of poses: tangent [rotation rad,
    # translation], map units; the first pose of each map and its distance to the furthest are held;
    # NaN and None = not known
    loops: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    # (L, 2) int64, frames of loops within a map
    joins: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    # (M, 2) int64, frames at which a map was joined to an earlier one
    closing_cpu_s: float = 0.0  # processor time of joining maps and closing loops

    def __len__(self) -> int:
        return len(self.timestamps)

    def posed(self) -> np.ndarray:
        """(F,) bool, frames with a pose from images, in a map with points.

        If no map has points the camera only rotated: all frames of the largest map count then.
        Maps with points in fewer than five frames are ignored.
        """
        found = self.statuses != FrameStatus.LOST
        with_points = np.unique(self.maps[self.statuses == FrameStatus.TRACKED])
        counts = np.bincount(self.maps[found], minlength=int(self.maps.max(initial=0)) + 1)
        large = with_points[counts[with_points] >= 5]
        if len(large):
            return found & np.isin(self.maps, large)
        found &= ~np.isin(self.maps, with_points)
        counts[with_points] = 0
        return found & (self.maps == np.argmax(counts))

    def usable(self) -> bool:
        """True if most frames are posed with points, so that the camera's path is known."""
        found = self.posed() & np.isfinite(self.distances)
        return bool(np.count_nonzero(found) > 0.5 * len(self))

    def pieces(self) -> list[Trajectory]:
        """Posed frames of each map in order of time; no two pieces are related.

        A map joined to an earlier one across a separate map is a piece of its own here.
        """
        return [Trajectory(self.timestamps[rows], self.world_T_rigs[rows]) for rows in self._runs()]

    def trajectory(self, keyframes: bool = False) -> Trajectory:
        """Posed frames of all pieces one after another, or keyframes alone.

        Each piece begins at the identity, which `gsba.trajectory.restarts` recognises.
        """
        poses, seen = self.world_T_rigs.copy(), set[int]()
        for rows in self._runs():
            number = int(self.maps[rows[0]])
            if number in seen:
                poses[rows] = inverse(poses[rows[0]]) @ poses[rows]
            seen.add(number)
        chosen = self.posed() & (self.keyframes if keyframes else True)
        return Trajectory(self.timestamps[chosen], poses[chosen])

    def _runs(self) -> list[np.ndarray]:
        """Rows of posed frames, cut wherever the next one is of another map."""
        rows = np.flatnonzero(self.posed())
        cuts = np.flatnonzero(np.diff(self.maps[rows])) + 1
        return [run for run in np.split(rows, cuts) if len(run)]

    def maps_in_turn(self) -> np.ndarray:
        """Number (F,) of the map that each frame is in, 1 = the first; 0 = in none."""
        numbers, posed = np.zeros(len(self), int), self.posed()
        numbers[posed] = 1 + np.unique(self.maps[posed], return_inverse=True)[1]
        return numbers

    def lost(self) -> list[Stretch]:
        """Stretches of frames without a pose."""
        edges = np.flatnonzero(np.diff((~self.posed()).astype(int), prepend=0, append=0))
        times = self.timestamps
        return [
            Stretch(float(times[a]), float(times[b - 1]), int(b - a))
            for a, b in zip(edges[::2], edges[1::2], strict=True)
        ]

    def report(self) -> dict[str, object]:
        """Summary of the odometry, for a JSON file."""
        posed = self.posed()
        steps = [np.diff(piece.world_T_rigs[:, :3, 3], axis=0) for piece in self.pieces()]
        return {
            "frames": len(self),
            "posed": int(posed.sum()),
            "keyframes": int((self.keyframes & posed).sum()),
            "turning_before_start": int((self.statuses == FrameStatus.TURNING).sum()),
            "maps": len(np.unique(self.maps[posed])),
            "loops": self.timestamps[self.loops].tolist(),
            "joins": self.timestamps[self.joins].tolist(),
            "path_lengths": [float(np.linalg.norm(some, axis=1).sum()) for some in steps],
            "lost": [asdict(stretch) for stretch in self.lost()],
            "cpu_ms_per_frame": 1e3 * self.cpu_s / max(len(self), 1),
            "closing_cpu_s": self.closing_cpu_s,
        }

    def summary(self) -> str:
        """Summary of the odometry in one line for the terminal."""
        told = self.report()
        line = f"{told['posed']} of {told['frames']} frames posed, {told['keyframes']} keyframes"
        if told["posed"] and not (self.statuses[self.posed()] == FrameStatus.TRACKED).any():
            line += ", rotations only: the camera did not move enough to tell where it went"
        for count, name in ((len(self.loops), "loop"), (len(self.joins), "map")):
            if count:
                how = "closed" if name == "loop" else "joined to those before"
                line += f", {count} {name}{'s' * (count > 1)} {how}"
        maps = len(np.unique(self.maps[self.posed()]))
        if maps > 1:
            line += f", {maps} maps that nothing ties together"
        return f"{line}, {told['cpu_ms_per_frame']:.0f} ms of processor time a frame"


def track_panoramas(
    panoramas: SmallPanoramas, seed: int = 0, checkpoint: Path | None = None
) -> Odometry:
    """Track a camera through a sequence, then join its maps and close its loops.

    Args:
        panoramas: all frames, in time order; damaged ones count as lost.
        checkpoint: file that tracking is saved to each minute, continued from if it is of the same
            panoramas, and removed at the end; None = no file.

    Raises:
        GsbaError: no picture can be decoded.
    """
    tracked = track_frames(panoramas, seed, checkpoint)
    if not tracked.rows:
        raise GsbaError(f"{panoramas.source}: none of its pictures could be decoded; copy it again")
    began = time.process_time()
    keyframes = _tracked_keyframes(tracked, panoramas)
    closed = close(keyframes, seed, Threads(os.cpu_count() or 1))
    closing_cpu_s = time.process_time() - began
    found = _odometry(tracked, keyframes, closed, panoramas.timestamps, closing_cpu_s)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    logger.info("%s", found.summary())
    for stretch in found.lost():
        logger.warning(
            "no pose from %.3f to %.3f s (%d frames): too dark, covered, or nothing in common "
            "with what was seen before",
            stretch.first_s,
            stretch.last_s,
            stretch.frames,
        )
    return found


def _tracked_keyframes(tracked: Tracking, panoramas: SmallPanoramas) -> TrackedKeyframes:
    """Keyframes with their poses, maps and features."""
    state, rows = tracked.state, np.array(tracked.rows)
    frames = np.array(state.keyframe_frames)
    statuses = np.array([record.status for record in state.records])
    numbers = np.array([record.map_number for record in state.records])
    distances = np.array([record.distance for record in state.records])
    maps = numbers[frames].astype(np.int32)
    known = np.isfinite(distances)
    with_points = np.unique(numbers[(statuses == FrameStatus.TRACKED) & known])
    # dark frames before the first map have a keyframe without features
    seen = np.array([len(ids) > 0 for ids, _ in state.keyframe_features])
    if len(with_points):
        distances = np.interp(np.arange(len(distances)), np.flatnonzero(known), distances[known])
    return TrackedKeyframes(
        np.array(state.keyframe_poses),
        maps,
        np.isin(maps, with_points) & seen,
        distances[frames],
        state.keyframe_features,
        tracked.pictures,
        panoramas.timestamps[rows[frames]],
        panoramas.width,
        panoramas.usable,
    )


def _odometry(
    tracked: Tracking,
    tracked_keyframes: TrackedKeyframes,
    closed: ClosedKeyframes,
    timestamps: np.ndarray,
    closing_cpu_s: float,
) -> Odometry:
    """Frames moved with their keyframes, before and after loop closure, as odometry's result."""
    num, records, rows = len(timestamps), tracked.state.records, np.array(tracked.rows)
    key_frames, sharp = tracked.state.keyframe_frames, np.zeros(num)
    sharp[rows] = tracked.sharpness
    keys = np.array([record.keyframe for record in records])
    key_T_rigs = np.array([record.key_T_rig for record in records])
    key_T_rigs[:, :3, 3] *= closed.scales[keys, None]
    poses, covariances = np.tile(np.eye(4), (num, 1, 1)), np.full((num, 6, 6), np.nan)
    poses[rows] = closed.world_T_keys[keys] @ key_T_rigs
    statuses, maps = np.full(num, FrameStatus.LOST, np.uint8), np.zeros(num, np.int32)
    statuses[rows] = [record.status for record in records]
    key_maps = np.array([r.map_number for r in records])[key_frames]
    joined = dict(zip(key_maps.tolist(), closed.maps.tolist(), strict=True))
    maps[rows] = [joined.get(record.map_number, record.map_number) for record in records]
    keyframes, distances, inliers = np.zeros(num, bool), np.full(num, np.nan), np.zeros(num, int)
    of_keys = rows[key_frames]
    keyframes[of_keys] = [len(ids) > 0 for ids, _ in tracked_keyframes.features]
    distances[rows] = [record.distance for record in records]
    distances[rows] *= closed.scales[keys]
    near = tracked_keyframes.distances[keys] * closed.scales[keys]
    covariances[rows] = carried_covariances(closed.covariances[keys], key_T_rigs, near)
    inliers[rows] = [record.inliers for record in records]
    known = statuses, maps, keyframes, distances, inliers, sharp
    ends = of_keys[closed.loops], of_keys[closed.joins]
    return Odometry(timestamps, poses, *known, tracked.cpu_s, covariances, *ends, closing_cpu_s)


_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")  # of a pose covariance


def write_odometry(found: Odometry, walk: Path, keyframes: Path, poses: Path, report: Path) -> None:
    """Write the poses of all frames and of the keyframes as TUM files, status and covariance of
    each pose as CSV, and the report as JSON."""
    for path in (walk, keyframes, poses, report):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(keyframes, found.trajectory(keyframes=True))
    write_json(report, found.report())
    upper, covariances = np.triu_indices(6), found.covariances
    if covariances is None:
        covariances = np.full((len(found), 6, 6), np.nan)
    numbers = np.hstack(
        [
            found.world_T_rigs[:, :3, 3],
            quaternion_from_rotation(found.world_T_rigs[:, :3, :3]),
            covariances[:, *upper],
        ]
    )
    names = [f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*upper, strict=True)]
    header = ["timestamp", "status", "keyframe", "map", "tx", "ty", "tz", "qw", "qx", "qy", "qz"]
    maps, posed = found.maps_in_turn(), found.posed()

    def rows() -> Iterator[list[object]]:
        for f, timestamp in enumerate(found.timestamps):
            status = FrameStatus(found.statuses[f]) if posed[f] else FrameStatus.LOST
            row = [repr(float(timestamp)), status.name.lower(), int(found.keyframes[f])]
            values = [f"{v:.9g}" if np.isfinite(v) else "" for v in numbers[f]]
            yield [*row, *([int(maps[f]), *values] if posed[f] else [""] * (1 + len(values)))]

    write_csv(poses, header + names, rows())
    write_tum(walk, found.trajectory())


def write_chosen(found: Odometry, rows: np.ndarray, path: Path) -> None:
    """Write the poses of chosen frames (N,) as a TUM file, whose times select them for extraction.

    A file that holds them already is not rewritten: frames extracted by it stay valid.
    """
    chosen = Trajectory(found.timestamps[rows], found.world_T_rigs[rows])
    if path.is_file():
        with suppress(GsbaError):  # one that cannot be read is rewritten
            written = read_trajectory(path)
            same = np.array_equal(written.timestamps, chosen.timestamps)
            poses = written.world_T_rigs, chosen.world_T_rigs
            if same and np.allclose(*poses, rtol=0, atol=1e-12):  # to the file's precision
                return
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(path, chosen)


MAX_TURN_DEG = 40.0  # rotation between successive chosen frames: doorways and turns keep frames


def choose_frames(found: Odometry, settings: OdometrySettings) -> np.ndarray:
    """Rows (N,) of the frames to refine.

    From one frame to the next the camera moves by at most `step` times the median distance of the
    scene, and rotates by at most `MAX_TURN_DEG`, wherever the video has frames that close; the
    sharpest of the last part of each such stretch is selected. Frames without a pose are left out.
    """
    count = settings.max_frames
    steps = _Steps.of(found, settings.step, np.deg2rad(MAX_TURN_DEG))
    rows = _chosen(found, steps, 1.0)
    if count is None or len(rows) <= count:
        return rows
    low, high = 1.0, 2.0
    while len(_chosen(found, steps, high)) > count:
        low, high = high, 2 * high
        if high > 1e6:  # more maps than frames are wanted
            return rows[np.linspace(0, len(rows) - 1, count).round().astype(int)]
    for _ in range(20):  # bisections of the interval of that factor
        middle = 0.5 * (low + high)
        if len(_chosen(found, steps, middle)) > count:
            low = middle
        else:
            high = middle
    return _chosen(found, steps, high)


@dataclass(frozen=True, slots=True)
class _Steps:
    """Distances between frames, in steps of the allowed length."""

    positions: np.ndarray  # (F, 3) float64, map units
    rotations: np.ndarray  # (F, 3, 3) float64
    allowed: np.ndarray  # (F,) float64, length of a step near each frame, map units
    max_turn: float  # radians

    @classmethod
    def of(cls, found: Odometry, step: float, max_turn: float) -> "_Steps":
        """Steps between frames; unknown distances of the scene are interpolated."""
        known = np.flatnonzero(np.isfinite(found.distances) & found.posed())
        distances = np.full(len(found), np.inf)
        if len(known):
            distances = np.interp(np.arange(len(found)), known, found.distances[known])
        poses = found.world_T_rigs
        return cls(poses[:, :3, 3], poses[:, :3, :3], step * distances, max_turn)

    def between(self, one: int, others: np.ndarray) -> np.ndarray:
        """Steps from one frame to others (N,)."""
        moved = np.linalg.norm(self.positions[others] - self.positions[one], axis=1)
        turned = rotation_angle(self.rotations[one].T @ self.rotations[others])
        shorter = np.minimum(self.allowed[others], self.allowed[one])
        return np.maximum(moved / shorter, turned / self.max_turn)


def _chosen(found: Odometry, steps: _Steps, longer: float) -> np.ndarray:
    """Rows of frames at most `longer` steps apart, in order of time, including the first of each
    map; another map may lie between the parts of one."""
    out: list[int] = []
    posed = found.posed()
    for number in np.unique(found.maps[posed]):
        rows = np.flatnonzero(posed & (found.maps == number))
        here = 0
        while here is not None:
            out.append(int(rows[here]))
            here = _next(rows, here, steps, longer, found.sharpness)
    return np.array(sorted(out), np.int64)


def _next(
    rows: np.ndarray, here: int, steps: _Steps, longer: float, sharpness: np.ndarray
) -> int | None:
    """Index into `rows` of the frame to select after `rows[here]`; None = no new frame follows."""
    reach, end = 32, len(rows)
    while True:
        ahead = np.arange(here + 1, min(here + 1 + reach, end))
        away = steps.between(int(rows[here]), rows[ahead]) / longer
        beyond = np.flatnonzero(away > 1)
        if len(beyond) or ahead[-1:].tolist() in ([], [end - 1]):
            break
        reach *= 2
    if not len(ahead):
        return None
    stop = int(beyond[0]) if len(beyond) else len(ahead)
    fit = np.flatnonzero(away[:stop] >= 0.6)  # the sharpest of the last part of the step
    if len(fit):
        return int(ahead[fit[np.argmax(sharpness[rows[ahead[fit]]])]])
    if not len(beyond):
        return None
    return int(ahead[max(stop - 1, 0)])
