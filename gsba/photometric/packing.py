"""Observations by patches, sorted into keypoints and tracks, some frames or points at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factors.threads import map_in_threads
from gsba.camera.rig import CubeRig, owner_faces
from gsba.disk import concatenated
from gsba.memory import release_mapped_files
from gsba.types import Counts, Keypoints, Sighted, Tracks
from gsba.types.records import slices, with_rows

_FRAMES_AT_ONCE = 32  # whose observations a thread holds: some 50 MB
_POINTS_AT_ONCE = 1 << 17


@dataclass(frozen=True, slots=True)
class Observed:
    """Observations of points, in any order."""

    points: np.ndarray  # (N,) int64, or int32 of many
    frames: np.ndarray  # (N,) int64, or int32 of many
    bearings_rig: np.ndarray  # (N, 3) float64, unit
    covariances: np.ndarray  # (N, 2, 2) float64, radians squared, on tangent_basis

    @classmethod
    def joined(cls, parts: "Iterator[Observed]", folder: Path | None) -> "Observed":
        """All of at least one part, in files of a folder or in memory (None)."""
        columns = (
            (
                part.points.astype(np.int32),
                part.frames.astype(np.int32),
                part.bearings_rig,
                part.covariances,
            )
            for part in parts
        )
        return cls(*concatenated(columns, folder))

    def __len__(self) -> int:
        return len(self.points)

    def of(self, points: np.ndarray) -> "Observed":
        """The observations with their points renumbered: n becomes `points[n]`."""
        return replace(self, points=points[self.points])

    def enlarged(self, factors: np.ndarray) -> "Observed":
        """The observations with the noise of pictures that were enlarged by factors (N,): their
        pixels' noise is correlated, so that residuals promise more than the pictures hold."""
        return replace(self, covariances=self.covariances * factors[:, None, None] ** 2)


@dataclass(frozen=True, slots=True)
class PointsInFrames:
    """Further properties of the points (J,), and the frames (F,)."""

    colors: np.ndarray  # (J, 3) uint8, RGB
    normals_world: np.ndarray  # (J, 3) of the surfaces, zero = unknown
    world_T_rigs: np.ndarray  # (F, 4, 4)


def pack(
    new: Observed,
    former: Observed,
    shown: PointsInFrames,
    rig: CubeRig,
    counts: Counts,
    folder: Path | None,
    num_threads: int,
) -> Sighted:
    """Observations as keypoints, frame by frame, and as tracks. Points observed once are left out.

    Args:
        new, former: by patches, and earlier ones; no point is in a frame twice.
        folder: of the arrays' files; None = they are in memory.
    """
    num_points, num_frames = len(shown.colors), len(shown.world_T_rigs)
    times = np.zeros(num_points, np.int64)
    for part in (new, former):
        times += np.bincount(part.points, minlength=num_points)
    sizes = np.zeros(num_frames, np.int64)
    by_frame = _by_frame((new, former), times > 1, sizes, shown, rig, num_threads)
    columns = concatenated(by_frame, folder)
    points, frames, is_new, normals = columns[:4]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    keypoints = Keypoints(starts, *columns[4:])
    of_tracks, seeing, rows = concatenated(_by_point(points, frames, starts, num_points), folder)
    num_tracks = int(of_tracks[-1]) + 1 if len(of_tracks) else 0
    tracks = Tracks(of_tracks, seeing, rows, num_tracks)
    return Sighted(keypoints, is_new, tracks, counts, normals)


def _by_frame(
    parts: Sequence[Observed],
    several: np.ndarray,
    sizes: np.ndarray,
    shown: PointsInFrames,
    rig: CubeRig,
    num_threads: int,
) -> Iterator[tuple[np.ndarray, ...]]:
    """Observations of points seen repeatedly (J,), by frame, then point; some frames at a time."""
    groups = list(slices(len(sizes), _FRAMES_AT_ONCE))

    def ordered(n: int) -> tuple[np.ndarray, ...]:
        some, chosen = groups[n], []
        for part in parts:
            inside = (part.frames >= some.start) & (part.frames < some.stop)
            rows = np.flatnonzero(inside)
            chosen.append(with_rows(part, rows[several[part.points[rows]]]))
        every = Observed.joined(iter(chosen), None)
        order = np.lexsort((every.points, every.frames))
        is_new, every = order < len(chosen[0]), with_rows(every, order)
        bearings, faces = every.bearings_rig, owner_faces(every.bearings_rig)
        lower = np.linalg.cholesky(np.linalg.inv(every.covariances))
        rotations = shown.world_T_rigs[every.frames, :3, :3]
        normals = np.einsum("oba,ob->oa", rotations, shown.normals_world[every.points])
        return (
            every.points,
            every.frames,
            is_new,
            normals.astype(np.float32),
            rig.project(bearings, faces),
            faces,
            bearings,
            np.linalg.det(every.covariances) ** 0.25,
            shown.colors[every.points],
            np.ascontiguousarray(np.swapaxes(lower, 1, 2)),
        )

    for found in map_in_threads(ordered, len(groups), num_threads):
        sizes += np.bincount(found[1], minlength=len(sizes))
        yield found
        release_mapped_files()


def _by_point(
    points: np.ndarray, frames: np.ndarray, starts: np.ndarray, num_points: int
) -> Iterator[tuple[np.ndarray, ...]]:
    """Points, frames and keypoints of observations (O,) reordered by point, some at a time."""
    number = 0
    for some in slices(num_points, _POINTS_AT_ONCE):
        rows = np.flatnonzero((points >= some.start) & (points < some.stop))
        rows = rows[np.argsort(points[rows], kind="stable")]
        there, compact = np.unique(points[rows], return_inverse=True)
        seeing = frames[rows]
        yield (
            (number + compact).astype(np.int32),
            seeing,
            (rows - starts[seeing]).astype(np.int32),
        )
        number += len(there)
        release_mapped_files()
