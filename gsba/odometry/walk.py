"""Odometry of a whole sequence: its poses, what is known of each, and what went wrong."""

import logging
import time
from dataclasses import asdict, dataclass

import numpy as np

from gsba.log import GsbaError, track
from gsba.odometry.panoramas import SmallPanoramas
from gsba.odometry.tracker import FrameStatus, Tracker
from gsba.types import Trajectory
from gsba.video.likeness import sharpness

logger = logging.getLogger(__name__)

_MIN_FRAMES_OF_MAP = 5  # fewer say nothing
_PATIENCE_S, _MIN_PATIENCE = 1.5, 8  # seconds, and frames, before a lost camera begins a new map


@dataclass(frozen=True, slots=True)
class Stretch:
    """Frames in a row."""

    first_s: float  # seconds, time of the first
    last_s: float  # seconds, time of the last
    frames: int


@dataclass(frozen=True, slots=True)
class Odometry:
    """Where the camera was during a sequence; each map has a world and a unit of its own."""

    timestamps: np.ndarray  # (F,) float64, seconds
    world_T_rigs: np.ndarray  # (F, 4, 4) float64, world of each frame's map
    statuses: np.ndarray  # (F,) uint8, FrameStatus
    maps: np.ndarray  # (F,) int32, 0 = the first map
    keyframes: np.ndarray  # (F,) bool
    distances: np.ndarray  # (F,) float64, median distance of points, map units; NaN = not known
    inliers: np.ndarray  # (F,) int32, features that fit the pose
    sharpness: np.ndarray  # (F,) float64, of the small picture; see gsba.video.likeness
    cpu_s: float  # processor time of tracking, decoding apart

    def __len__(self) -> int:
        return len(self.timestamps)

    def posed(self) -> np.ndarray:
        """(F,) bool, frames whose pose images tell, in a map that has points.

        Where no map has points the camera only turned: all frames of the first map count then.
        """
        found = self.statuses != FrameStatus.LOST
        with_points = np.unique(self.maps[self.statuses == FrameStatus.TRACKED])
        counts = np.bincount(self.maps[found], minlength=int(self.maps.max(initial=0)) + 1)
        if not len(with_points):
            return found & (self.maps == np.argmax(counts))
        large = with_points[counts[with_points] >= _MIN_FRAMES_OF_MAP]
        return found & np.isin(self.maps, large)

    def usable(self) -> bool:
        """Whether most frames are posed, and the camera moved enough to tell where it went."""
        found = self.posed() & np.isfinite(self.distances)
        return bool(np.count_nonzero(found) > 0.5 * len(self))

    def pieces(self) -> list[Trajectory]:
        """Posed frames of each map; no two maps are related."""
        posed = self.posed()
        rows = [np.flatnonzero(posed & (self.maps == m)) for m in np.unique(self.maps[posed])]
        return [Trajectory(self.timestamps[some], self.world_T_rigs[some]) for some in rows]

    def trajectory(self, keyframes: bool = False) -> Trajectory:
        """Posed frames of all maps one after another, or keyframes alone.

        Each map begins at the identity, by which `gsba.trajectory.restarts` tells them apart.
        """
        rows = self.posed() & (self.keyframes if keyframes else True)
        return Trajectory(self.timestamps[rows], self.world_T_rigs[rows])

    def lost(self) -> list[Stretch]:
        """Stretches of frames without a pose."""
        return self._stretches(~self.posed())

    def path_lengths(self) -> list[float]:
        """Of each map, in its unit."""
        steps = [np.diff(piece.world_T_rigs[:, :3, 3], axis=0) for piece in self.pieces()]
        return [float(np.linalg.norm(some, axis=1).sum()) for some in steps]

    def report(self) -> dict[str, object]:
        """What happened, for a file."""
        posed = self.posed()
        return {
            "frames": len(self),
            "posed": int(posed.sum()),
            "keyframes": int((self.keyframes & posed).sum()),
            "turning_before_start": int((self.statuses == FrameStatus.TURNING).sum()),
            "maps": len(np.unique(self.maps[posed])),
            "path_lengths": self.path_lengths(),
            "lost": [asdict(stretch) for stretch in self.lost()],
            "cpu_ms_per_frame": 1e3 * self.cpu_s / max(len(self), 1),
        }

    def summary(self) -> str:
        """One line for the terminal."""
        told = self.report()
        line = f"{told['posed']} of {told['frames']} frames posed, {told['keyframes']} keyframes"
        if not (self.statuses == FrameStatus.TRACKED).any():
            line += ", rotations only: the camera did not move enough to tell where it went"
        elif len(self.pieces()) > 1:
            line += f", {len(self.pieces())} maps that nothing ties together"
        return f"{line}, {told['cpu_ms_per_frame']:.0f} ms of processor time a frame"

    def _stretches(self, chosen: np.ndarray) -> list[Stretch]:
        edges = np.flatnonzero(np.diff(chosen.astype(int), prepend=0, append=0))
        times = self.timestamps
        return [
            Stretch(float(times[a]), float(times[b - 1]), int(b - a))
            for a, b in zip(edges[::2], edges[1::2], strict=True)
        ]


def track_panoramas(panoramas: SmallPanoramas, seed: int = 0) -> Odometry:
    """Follow a camera through a sequence.

    Args:
        panoramas: all frames, in time order; damaged ones count as lost.
        seed: of the sampling at the start of a map.

    Raises:
        GsbaError: no picture can be decoded.
    """
    num = len(panoramas)
    interval = float(np.median(np.diff(panoramas.timestamps)))
    patience = max(_MIN_PATIENCE, round(_PATIENCE_S / interval))
    tracker = Tracker(panoramas.width, panoramas.usable, seed, patience)
    rows, sharp, cpu_s = [], np.zeros(num), 0.0
    pictures = panoramas.read(range(num), False)
    for row, grey in track(pictures, "tracking", num):
        began = time.thread_time()
        tracker.add(grey)
        sharp[row] = sharpness(grey)
        rows.append(row)
        cpu_s += time.thread_time() - began
    if not rows:
        raise GsbaError(f"{panoramas.source}: none of its pictures could be decoded; copy it again")
    records = tracker.records
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[rows] = tracker.world_T_rigs()
    statuses = np.full(num, FrameStatus.LOST, np.uint8)
    statuses[rows] = [record.status for record in records]
    maps = np.zeros(num, np.int32)
    maps[rows] = [record.map_number for record in records]
    keyframes, distances, inliers = np.zeros(num, bool), np.full(num, np.nan), np.zeros(num, int)
    keyframes[np.array(rows)[tracker.keyframe_frames]] = True
    distances[rows] = [record.distance for record in records]
    inliers[rows] = [record.inliers for record in records]
    found = Odometry(
        panoramas.timestamps, poses, statuses, maps, keyframes, distances, inliers, sharp, cpu_s
    )
    _log(found)
    return found


def _log(found: Odometry) -> None:
    logger.info("%s", found.summary())
    for stretch in found.lost():
        logger.warning(
            "no pose from %.3f to %.3f s (%d frames): too dark, covered, or nothing in common "
            "with what was seen before",
            stretch.first_s,
            stretch.last_s,
            stretch.frames,
        )
