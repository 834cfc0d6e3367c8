"""Odometry of a whole sequence: poses, statuses, covariances, and the report."""

import logging
import os
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.odometry.closing import ClosedKeyframes, TrackedKeyframes, close
from gsba.odometry.panoramas import SmallPanoramas
from gsba.odometry.pose_graph import carried_covariances
from gsba.odometry.tracker_state import FrameStatus
from gsba.odometry.tracking import Tracking, track_frames
from gsba.store.shards import Threads, Workers
from gsba.types import Trajectory

logger = logging.getLogger(__name__)


def _no_pairs() -> np.ndarray:
    return np.zeros((0, 2), np.int64)


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
    loops: np.ndarray = field(default_factory=_no_pairs)  # (L, 2) int64, frames of loops within a
    # map
    joins: np.ndarray = field(default_factory=_no_pairs)  # (M, 2) int64, frames at which a map was
    # joined to an earlier one
    closing_cpu_s: float = 0.0  # processor time of joining maps and closing loops

    def __len__(self) -> int:
        return len(self.timestamps)

    def posed(self) -> np.ndarray:
        """(F,) bool, frames with a pose from images, in a map with points.

        If no map has points the camera only rotated: all frames of the largest map count then.
        """
        found = self.statuses != FrameStatus.LOST
        with_points = np.unique(self.maps[self.statuses == FrameStatus.TRACKED])
        counts = np.bincount(self.maps[found], minlength=int(self.maps.max(initial=0)) + 1)
        if not len(with_points):
            return found & (self.maps == np.argmax(counts))
        large = with_points[counts[with_points] >= 5]  # maps with fewer frames are ignored
        return found & np.isin(self.maps, large)

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

    def path_lengths(self) -> list[float]:
        """Path length of each map, in its unit."""
        steps = [np.diff(piece.world_T_rigs[:, :3, 3], axis=0) for piece in self.pieces()]
        return [float(np.linalg.norm(some, axis=1).sum()) for some in steps]

    def report(self) -> dict[str, object]:
        """Summary of the odometry, for a JSON file."""
        posed = self.posed()
        return {
            "frames": len(self),
            "posed": int(posed.sum()),
            "keyframes": int((self.keyframes & posed).sum()),
            "turning_before_start": int((self.statuses == FrameStatus.TURNING).sum()),
            "maps": len(np.unique(self.maps[posed])),
            "loops": self.timestamps[self.loops].tolist(),
            "joins": self.timestamps[self.joins].tolist(),
            "path_lengths": self.path_lengths(),
            "lost": [asdict(stretch) for stretch in self.lost()],
            "cpu_ms_per_frame": 1e3 * self.cpu_s / max(len(self), 1),
            "closing_cpu_s": self.closing_cpu_s,
        }

    def summary(self) -> str:
        """Summary of the odometry in one line for the terminal."""
        told = self.report()
        line = f"{told['posed']} of {told['frames']} frames posed, {told['keyframes']} keyframes"
        if not (self.statuses == FrameStatus.TRACKED).any():
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
    panoramas: SmallPanoramas,
    seed: int = 0,
    workers: Workers | None = None,
    with_loops: bool = True,
    checkpoint: Path | None = None,
) -> Odometry:
    """Track a camera through a sequence, then join its maps and close its loops.

    Args:
        panoramas: all frames, in time order; damaged ones count as lost.
        workers: threads or processes that compare places; None = threads of this process.
        with_loops: False = join no maps, close no loops, estimate no covariances.
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
    closed = ClosedKeyframes.unchanged(keyframes)
    if with_loops:
        closed = close(keyframes, seed, workers or Threads(os.cpu_count() or 1))
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
    if len(with_points):
        distances = np.interp(np.arange(len(distances)), np.flatnonzero(known), distances[known])
    return TrackedKeyframes(
        np.array(state.keyframe_poses),
        maps,
        np.isin(maps, with_points),
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
    keyframes[of_keys] = True
    distances[rows] = [record.distance for record in records]
    distances[rows] *= closed.scales[keys]
    near = tracked_keyframes.distances[keys] * closed.scales[keys]
    covariances[rows] = carried_covariances(closed.covariances[keys], key_T_rigs, near)
    inliers[rows] = [record.inliers for record in records]
    known = statuses, maps, keyframes, distances, inliers, sharp
    ends = of_keys[closed.loops], of_keys[closed.joins]
    return Odometry(timestamps, poses, *known, tracked.cpu_s, covariances, *ends, closing_cpu_s)
