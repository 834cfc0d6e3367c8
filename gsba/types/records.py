"""Records that stages pass to one another: arrays, with one comment per field."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum, StrEnum
from typing import Any, TypeVar

import numpy as np

from gsba.types.frame_set import PictureFormat

T = TypeVar("T", bound=Any)  # a dataclass

AT_ONCE = 1 << 16  # observations whose poses are held together: 9 MB


def with_rows(record: T, rows: np.ndarray) -> T:
    """A dataclass with rows (N,), int or bool, of all its arrays."""
    every = {entry.name: getattr(record, entry.name) for entry in fields(record)}
    arrays = {name: value for name, value in every.items() if isinstance(value, np.ndarray)}
    return replace(record, **{name: array[rows] for name, array in arrays.items()})


def slices(num: int, most: int) -> Iterator[slice]:
    """Ranges of at most `most` of `num` items that are held together; at least one."""
    for first in range(0, max(num, 1), most):
        yield slice(first, min(first + most, num))


def spread_rows(num: int, count: int) -> np.ndarray:
    """Rows (count,) of `num` in the middles of equal parts; some repeat if there are fewer."""
    return (2 * np.arange(count) + 1) * num // max(2 * count, 1)


class PoseSource(IntEnum):
    """Source of a frame's coarse pose."""

    SLAM = 0  # an entry of the trajectory, of a file or an odometry
    INTERPOLATED = 1  # between two entries
    EXTRAPOLATED = 2  # before the first or after the last entry
    NONE = 3  # no trajectory: a placeholder


class RunStart(StrEnum):
    """Source of a run's initial poses, in words for the user."""

    TRAJECTORY = "trajectory file"
    ODOMETRY = "odometry"  # of the run's own video
    PAIRS = "pairs of frames"
    EARLIER_RUN = "earlier run"


class PoseStatus(IntEnum):
    """Result of a frame."""

    REFINED = 0  # images constrain its pose
    UNREFINED = 1  # it has no matches: its priors alone give its pose


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of items that a stage received, kept and dropped, with the reasons."""

    received: int  # items that came in
    kept: int  # items that went on
    unit: str  # name of the items: "frames", "matches", ...
    dropped: Mapping[str, int] = field(default_factory=dict)  # reason -> number of items


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Timed rig poses in one world."""

    timestamps: np.ndarray  # (N,) float64, seconds, strictly increasing
    world_T_rigs: np.ndarray  # (N, 4, 4) float64, map units
    origin: np.ndarray | None = None  # (3,) float64: world of the file = this world + origin; None
    # = the same


@dataclass(frozen=True, slots=True)
class CoarsePoses:
    """One coarse pose for every frame of a FrameSet."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, map units
    sources: np.ndarray  # (F,) uint8, PoseSource
    time_offset: float  # seconds added to frame times to reach the trajectory's clock
    segments: np.ndarray | None = None  # (F,) int32, trajectory piece of each frame, ascending;
    # each piece has its own world until pieces are joined; None = there is one
    origin: np.ndarray | None = None  # (3,) float64, of the first piece, see Trajectory

    @property
    def absent(self) -> bool:
        """True if there is no trajectory."""
        return bool((self.sources == PoseSource.NONE).all())

    def taken(self, rows: np.ndarray) -> "CoarsePoses":
        """Poses of frames `rows` (F',), in one piece."""
        poses, sources = self.world_T_rigs[rows], self.sources[rows]
        return replace(self, world_T_rigs=poses, sources=sources, segments=None)


@dataclass(frozen=True, slots=True)
class GyroConstraints:
    """Rotations between frames and rates, integrated from a gyro, rig axes."""

    steps: np.ndarray  # (F - 1, 3) float64, rotation vectors of f_R_next, radians
    step_sigmas: np.ndarray  # (F - 1,) float64, radians per axis; infinite = not known
    rates: np.ndarray  # (F, 3) float64, rad/s, during each frame; NaN = not known
    rate_sigma: float  # rad/s per axis


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints of one frame, face after face, the strongest of each face first."""

    pixels: np.ndarray  # (K, 2) float64, (u, v) on the owning face, corner origin
    faces: np.ndarray  # (K,) uint8, index into FACES
    bearings_rig: np.ndarray  # (K, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (K,) float64, radians, per-axis localisation noise
    descriptors: np.ndarray  # (K, D) uint8 or float32, of unit length up to a common factor
    colors: np.ndarray  # (K, 3) uint8, RGB at the keypoint
    scores: np.ndarray | None = None  # (K,) float32, a network's confidence in each keypoint

    def __len__(self) -> int:
        return len(self.faces)


@dataclass(frozen=True, slots=True)
class Keypoints:
    """Keypoints of all frames back to back, without descriptors."""

    starts: np.ndarray  # (F + 1,) int64: frame f owns rows starts[f]:starts[f + 1]
    pixels: np.ndarray  # (N, 2) float64, (u, v) on the owning face, corner origin
    faces: np.ndarray  # (N,) uint8, index into FACES
    bearings_rig: np.ndarray  # (N, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (N,) float64, radians
    colors: np.ndarray  # (N, 3) uint8, RGB
    sqrt_infos: np.ndarray | None = None  # (N, 2, 2) 1/rad, square-root information on the
    # bearings' tangent_basis, where noise is anisotropic; None = 1 / sigmas_rad
    origins_rig: np.ndarray | None = None  # (N, 3) float64, rig frame, map units: origin of each
    # ray; None = the rig's centre

    def origins_of(self, rows: np.ndarray) -> np.ndarray | None:
        """Origins (O, 3) of the rays of rows (O,), rig frame; None = the rig's centre."""
        return None if self.origins_rig is None else self.origins_rig.take(rows, axis=0)

    def frames(self) -> np.ndarray:
        """Frame (N,) of each keypoint."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def bearings_of(self, frame: int) -> np.ndarray:
        """Bearings (K, 3) of one frame."""
        return self.bearings_rig[self.starts[frame] : self.starts[frame + 1]]

    def matched(self, pair: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bearings (m, 3) of matched keypoints (m, 2) in either frame of a pair (2,)."""
        return self.bearings_of(pair[0])[rows[:, 0]], self.bearings_of(pair[1])[rows[:, 1]]

    def rows(self, tracks: "Tracks") -> np.ndarray:
        """Row (O,) of every observation of the tracks."""
        return self.starts[tracks.frames] + tracks.keypoints

    def roots(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Square-root information (O, 2, 2) of rows (O,) on their tangent_basis, 1/rad."""
        if self.sqrt_infos is not None:
            return self.sqrt_infos[rows]
        return np.eye(2) / self.sigmas_rad[rows][:, None, None]

    def scaled_noise(self, factors: np.ndarray | float) -> "Keypoints":
        """Keypoints whose noise is `factors`, () or (N,), times as large."""
        factors, infos = np.asarray(factors), self.sqrt_infos
        infos = None if infos is None else infos / factors[..., None, None]
        return replace(self, sigmas_rad=self.sigmas_rad * factors, sqrt_infos=infos)

    def at(self, rows: np.ndarray, starts: np.ndarray) -> "Keypoints":
        """Keypoints in rows (N',), which frames own as in `starts` (F' + 1,) int64."""
        infos = None if self.sqrt_infos is None else self.sqrt_infos.take(rows, axis=0)
        return Keypoints(
            starts,
            self.pixels.take(rows, axis=0),
            self.faces[rows],
            self.bearings_rig.take(rows, axis=0),
            self.sigmas_rad[rows],
            self.colors[rows],
            infos,
            self.origins_of(rows),
        )

    def of_frames(self, frames: np.ndarray) -> "Keypoints":
        """Keypoints of frames (F',), ascending, which are numbered from 0."""
        sizes = np.diff(self.starts)[frames]
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        return self.at(np.flatnonzero(np.isin(self.frames(), frames)), starts)


@dataclass(frozen=True, slots=True)
class Matches:
    """Keypoint correspondences of frame pairs, stored back to back."""

    pairs: np.ndarray  # (P, 2) int32, frame indices (f0 < f1)
    offsets: np.ndarray  # (P + 1,) int64: pair p owns rows offsets[p]:offsets[p + 1]
    keypoints: np.ndarray  # (M, 2) int32, keypoint index in f0 and in f1

    @classmethod
    def of_rows(cls, pairs: np.ndarray, rows: Sequence[np.ndarray]) -> "Matches":
        """Matches from the rows (m, 2) int32 of each pair (P, 2)."""
        keypoints = np.concatenate([np.zeros((0, 2), np.int32), *rows])
        return cls(pairs, np.cumsum([0, *map(len, rows)]), keypoints)

    def of(self, pair: int) -> np.ndarray:
        """Rows of one pair, (m, 2) int32."""
        return self.keypoints[self.offsets[pair] : self.offsets[pair + 1]]

    def taken(self, pairs: Sequence[int] | np.ndarray) -> "Matches":
        """Matches of pairs with these indices, in the given order."""
        rows = [self.of(int(p)) for p in pairs]
        return Matches.of_rows(self.pairs[list(pairs)].reshape(-1, 2), rows)


@dataclass(frozen=True, slots=True)
class VerifiedPairs:
    """Pairs whose matches fit one relative pose within the trajectory's tolerance."""

    matches: Matches  # inliers only
    f0_T_f1s: np.ndarray  # (P, 4, 4) float64, translation of unit length
    direction_sigmas: np.ndarray  # (P,) float64, radians, of the translation's direction; infinite
    # = the motion may be a pure rotation
    counts: Counts  # of pairs

    @classmethod
    def none(cls) -> "VerifiedPairs":
        """No pairs."""
        none = Matches.of_rows(np.zeros((0, 2), np.int32), ())
        return cls(none, np.zeros((0, 4, 4)), np.zeros(0), Counts(0, 0, "pairs"))

    @classmethod
    def joined(cls, parts: Sequence["VerifiedPairs"]) -> "VerifiedPairs":
        """Pairs of several sets, by distance of their frames in time; counts of the first set."""
        pairs = np.concatenate([part.matches.pairs for part in parts])
        rows = [part.matches.of(p) for part in parts for p in range(len(part.matches.pairs))]
        poses = np.concatenate([part.f0_T_f1s for part in parts])
        sigmas = np.concatenate([part.direction_sigmas for part in parts])
        every = cls(Matches.of_rows(pairs, rows), poses, sigmas, parts[0].counts)
        return every.taken(np.lexsort((pairs[:, 0], pairs[:, 1] - pairs[:, 0])).tolist())

    def taken(self, rows: Sequence[int]) -> "VerifiedPairs":
        """Pairs with these indices, in the given order."""
        chosen = np.asarray(rows, np.int64)
        return replace(with_rows(self, chosen), matches=self.matches.taken(chosen))

    def frames(self) -> set[tuple[int, int]]:
        """Frames (f0, f1) of each pair."""
        return {(int(f0), int(f1)) for f0, f1 in self.matches.pairs}

    def within(self, pieces: np.ndarray | None) -> "VerifiedPairs":
        """Pairs whose two frames are of the same piece (F,) int; None = there is one."""
        if pieces is None:
            return self
        f0, f1 = self.matches.pairs.T
        return self.taken(np.flatnonzero(pieces[f0] == pieces[f1]).tolist())

    def missing(self, chosen: np.ndarray) -> np.ndarray:
        """Pairs of `chosen` (P, 2) that this set lacks."""
        present = self.frames()
        rows = [pair for pair in chosen.tolist() if tuple(pair) not in present]
        return np.array(rows, np.int32).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of scene points, sorted by point, then by frame; every point has one.

    Functions that make or filter tracks keep this order. Functions that read tracks also accept
    points without observations: no frame sees these.
    """

    points: np.ndarray  # (O,) int32, point index j, non-decreasing
    frames: np.ndarray  # (O,) int32, frame index f
    keypoints: np.ndarray  # (O,) int32, keypoint index k in frame f
    num_points: int

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def joined(cls, parts: "Sequence[Tracks]") -> "Tracks":
        """Tracks of several parts, the points of each numbered after those before."""
        starts = np.cumsum([0, *(part.num_points for part in parts)])
        points = [part.points + start for part, start in zip(parts, starts, strict=False)]
        return cls(
            np.concatenate(points).astype(np.int32),
            np.concatenate([part.frames for part in parts]),
            np.concatenate([part.keypoints for part in parts]).astype(np.int32),
            int(starts[-1]),
        )

    def hosts(self) -> np.ndarray:
        """First frame (J,) that observes each point: the point moves with it; -1 = none."""
        first = np.flatnonzero(np.diff(self.points, prepend=-1))
        hosts = np.full(self.num_points, -1, self.frames.dtype)
        hosts[self.points[first]] = self.frames[first]
        return hosts

    def of(self, points: np.ndarray) -> "Tracks":
        """Tracks of the points `points` (J,) bool, renumbered."""
        rows = points[self.points]
        numbers = (np.cumsum(points) - 1).astype(np.int32)[self.points[rows]]
        num = int(np.count_nonzero(points))
        return Tracks(numbers, self.frames[rows], self.keypoints[rows], num)

    def seen_twice(self, rows: np.ndarray) -> np.ndarray:
        """Those of the observations `rows` (O,) bool whose point has two of them or more."""
        lengths = np.bincount(self.points[rows], minlength=self.num_points)
        return rows & (lengths[self.points] > 1)

    def of_observations(self, rows: np.ndarray) -> "Tracks":
        """Tracks of the observations `rows` (O,) bool; points without any are left out."""
        numbers = np.cumsum(np.diff(self.points[rows], prepend=-1) > 0) - 1
        num = int(numbers[-1]) + 1 if len(numbers) else 0
        return Tracks(numbers.astype(np.int32), self.frames[rows], self.keypoints[rows], num)


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Scene points and their inlier observations."""

    points_world: np.ndarray  # (J, 3) float64, map units
    tracks: Tracks  # their observations; point indices are rows of points_world
    counts: Counts  # of tracks

    def of(self, points: np.ndarray) -> "Landmarks":
        """Points (J,) bool and their observations."""
        return Landmarks(self.points_world[points], self.tracks.of(points), self.counts)

    def moved(self, scales: np.ndarray, moves: np.ndarray) -> "Landmarks":
        """Points moved by the similarity of their host frames: scales (F,), moves (F, 4, 4)."""
        hosts = self.tracks.hosts()
        turned = np.einsum("jik,jk->ji", moves[hosts, :3, :3], self.points_world)
        points = scales[hosts, None] * turned + moves[hosts, :3, 3]
        return Landmarks(points, self.tracks, self.counts)


@dataclass(frozen=True, slots=True)
class Iteration:
    """One attempted step of the solver. Iteration 0 is the start."""

    number: int
    cost: float  # total robust cost of the attempt
    costs: Mapping[str, float]  # family -> cost; empty if the step was rejected
    damping: float  # lambda of the step
    accepted: bool
    seconds: float  # wall time of this attempt


@dataclass(frozen=True, slots=True)
class Round:
    """One bundle adjustment: its gate, its result and the decision about it."""

    gate_sigmas: float  # observations with larger residuals were left out
    noise: float  # estimated noise after the round, in units of the features' own sigmas
    observations: int  # number used
    points: int  # number used
    support: int  # inliers of all tracks within the last gate, under the round's poses
    accepted: bool  # False: the poses before the round have more inliers and were kept
    iterations: tuple[Iteration, ...]  # cost by family
    reason: str  # why the solver stopped


@dataclass(frozen=True, slots=True)
class FamilyVariables:
    """Variables that belong to families of residuals, see `gsba.bundle.families`."""

    keys: np.ndarray  # (V,) int64, GTSAM keys
    kinds: tuple[str, ...]  # (V) GTSAM type of each
    counts: np.ndarray  # (V,) int64, parameters of each variable
    data: np.ndarray  # (sum of counts,) float64, values of the parameters


@dataclass(frozen=True, slots=True)
class Solution:
    """Poses and points after the last accepted round."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64
    landmarks: Landmarks
    noise: float  # of observations, in units of the features' own sigmas
    rounds: tuple[Round, ...]
    variables: FamilyVariables | None = None  # of families; None = no family has any

    @property
    def counts(self) -> Counts:
        """Counts of tracks."""
        return self.landmarks.counts

    @classmethod
    def without_points(cls, world_T_rigs: np.ndarray) -> "Solution":
        """Solution with initial poses (F, 4, 4) and no points."""
        nothing = np.zeros(0, np.int32)
        tracks = Tracks(nothing, nothing, nothing, 0)
        landmarks = Landmarks(np.zeros((0, 3)), tracks, Counts(0, 0, "tracks"))
        return cls(world_T_rigs, landmarks, 1.0, ())

    def observations(self) -> np.ndarray:
        """Number of observations of each frame (F,)."""
        return np.bincount(self.landmarks.tracks.frames, minlength=len(self.world_T_rigs))

    def carries(self, before: "Solution", least: int) -> bool:
        """True if every frame with `least` observations in `before` has as many here."""
        return bool(np.all((self.observations() >= least) | (before.observations() < least)))

    def median_depth(self) -> float:
        """Median distance of points from observing frames, map units; 0 without points."""
        tracks, points = self.landmarks.tracks, self.landmarks.points_world
        depths = np.empty(len(tracks))
        for some in slices(len(tracks), AT_ONCE):
            offsets = points[tracks.points[some]] - self.world_T_rigs[tracks.frames[some], :3, 3]
            depths[some] = np.linalg.norm(offsets, axis=1)
        return float(np.median(depths, overwrite_input=True)) if len(depths) else 0.0

    def points_by_keypoint(self, keypoints: Keypoints) -> "KnownPoints":
        """Points of each frame's keypoints (K_f, 3), rig frame, NaN where unknown."""
        frames = self.landmarks.tracks.frames
        order = np.argsort(frames, kind="stable")
        starts = np.searchsorted(frames[order], np.arange(len(self.world_T_rigs) + 1))
        return KnownPoints(self, np.diff(keypoints.starts), order, starts)


@dataclass(frozen=True, slots=True)
class KnownPoints:
    """Points of the keypoints of each frame, computed on access."""

    solved: Solution
    sizes: np.ndarray  # (F,) number of keypoints
    order: np.ndarray  # (O,) observations, frame by frame
    starts: np.ndarray  # (F + 1,) int: observations of frame f are order[starts[f]:starts[f + 1]]

    def __getitem__(self, frame: int) -> np.ndarray:
        """Points (K_f, 3) of one frame's keypoints, rig frame, NaN where unknown."""
        landmarks, world_T_rig = self.solved.landmarks, self.solved.world_T_rigs[frame]
        rows = self.order[self.starts[frame] : self.starts[frame + 1]]
        offsets = landmarks.points_world[landmarks.tracks.points[rows]] - world_T_rig[:3, 3]
        known = np.full((self.sizes[frame], 3), np.nan)
        known[landmarks.tracks.keypoints[rows]] = offsets @ world_T_rig[:3, :3]
        return known


@dataclass(frozen=True, slots=True)
class Sighted:
    """Observations from aligned patches, or the former ones where alignment failed."""

    keypoints: Keypoints  # one for each observation
    aligned: np.ndarray  # (N,) bool, True = from an aligned patch
    tracks: Tracks
    counts: Counts  # of observations
    normals_rig: np.ndarray | None = None  # (N, 3) float32, normal of each observed surface, zero =
    # unknown; None = all are unknown


@dataclass(frozen=True, slots=True)
class JointErrors:
    """Joint distribution of pose errors x_f; tangents are those of the pose covariances."""

    neighbours: np.ndarray  # (F - 1, 6, 6) float64, E[x_f x_(f+1)^T], NaN = none
    draws: np.ndarray  # (D, F, 6) float32, samples of the joint distribution, NaN = none

    def scaled(self, factors: np.ndarray) -> "JointErrors":
        """Distribution of errors that are multiplied by factors (F, 6)."""
        neighbours = factors[:-1, :, None] * self.neighbours * factors[1:, None, :]
        draws = np.empty_like(self.draws)
        np.multiply(self.draws, factors, out=draws, casting="same_kind")
        return JointErrors(neighbours, draws)

    def taken(self, rows: np.ndarray) -> "JointErrors":
        """Distribution of poses `rows` (F',), ascending; NaN across poses that are left out."""
        near = (np.diff(rows) == 1)[:, None, None]
        neighbours = np.where(near, self.neighbours[rows[:-1]], np.nan)
        return JointErrors(neighbours, self.draws[:, rows])


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """Refined poses and point cloud, from which exports and reports are made."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, world of the SLAM trajectory, map units
    pose_covariances: np.ndarray  # (F, 6, 6) float64, [rotation rad, translation], NaN = none
    pose_statuses: np.ndarray  # (F,) uint8, PoseStatus
    points_world: np.ndarray  # (J, 3) float64, map units
    point_colors: np.ndarray  # (J, 3) uint8, RGB
    point_errors: np.ndarray  # (J,) float64, radians, mean angular residual
    observation_points: np.ndarray  # (O,) int32, non-decreasing
    observation_frames: np.ndarray  # (O,) int32
    observation_bearings: np.ndarray  # (O, 3) float64, unit, rig frame
    observation_sigmas: np.ndarray  # (O,) float64, radians
    formats: tuple[PictureFormat, ...] = ()  # (C,) of each camera's pictures, as calibrated by the
    # map, which these bearings are read by; () = as the frames were scanned
    components: np.ndarray | None = None  # (F,) int32, map of each frame, 0 = the largest; each map
    # has its own world; frames in no map have numbers of their own after those of the maps; None =
    # there is one map
    joint_errors: JointErrors | None = None  # joint distribution of pose_covariances; None = none
    observation_origins: np.ndarray | None = None  # (O, 3) float64, rig frame, map units: origin of
    # each ray; None = the rig's centre
    lens_baseline: tuple[float, float] | None = None  # distance of the two lenses and its standard
    # deviation, map units, infinite if only lenses that no setting names were found; None = one
    vertical: np.ndarray | None = None  # (3,) float64, unit, up or down by an accelerometer; None =
    # there was none
    map_scales: np.ndarray | None = None  # (C,) float64, units of each component's world per unit
    # of the largest map's; None = there is one map
    origin: np.ndarray | None = None  # (3,) float64: world of the trajectory's file = world of the
    # largest map + origin; None = the same

    @property
    def num_maps(self) -> int:
        """Number of maps; a single frame is no map."""
        if self.components is None:
            return 1
        return 1 + int(np.count_nonzero(np.bincount(self.components)[1:] > 1))

    def map_numbers(self) -> np.ndarray:
        """Map (F,) int64 of each frame, 1 = the largest; 0 = none."""
        if self.components is None:
            return np.ones(len(self.world_T_rigs), np.int64)
        return np.where(self.components < self.num_maps, self.components + 1, 0)

    def frames_of_map(self, number: int) -> np.ndarray:
        """Frames (F',) int64 of a map, 1 = the largest."""
        return np.flatnonzero(self.map_numbers() == number)

    def largest_map(self) -> np.ndarray:
        """Frames (F',) int64 of the largest map, which is exported."""
        return self.frames_of_map(1)

    def of_map(self, number: int) -> "Reconstruction":
        """One map alone, 1 = the largest, in its own world and unit."""
        found = self.taken(self.frames_of_map(number))
        baseline, origins = self.lens_baseline, found.observation_origins
        if origins is not None and not origins.any():  # cameras of two lenses took other maps alone
            baseline = None
        scale = self.map_scale(number)
        baseline = baseline and (scale * baseline[0], scale * baseline[1])
        found = replace(found, lens_baseline=baseline, map_scales=None)
        # Vertical and origin are known in the world of the largest map.
        return found if number == 1 else replace(found, vertical=None, origin=None)

    def map_scale(self, number: int) -> float:
        """Units of a map's world per unit of the largest map's."""
        return 1.0 if self.map_scales is None else float(self.map_scales[number - 1])

    def observations_by_frame(self) -> list[np.ndarray]:
        """Rows (m,) int64 of the observations of each frame."""
        order = np.argsort(self.observation_frames, kind="stable")
        numbers = np.arange(1, len(self.world_T_rigs))
        return np.split(order, np.searchsorted(self.observation_frames[order], numbers))

    def pieces(self) -> "Iterator[Reconstruction]":
        """The reconstruction with some of its observations at a time, all of a point together; one
        piece at least."""
        origins, points = self.observation_origins, self.observation_points
        stop = 0
        while True:
            start, stop = stop, min(stop + AT_ONCE, len(points))
            if stop < len(points):
                before = int(np.searchsorted(points, points[stop]))
                after = int(np.searchsorted(points, points[start], side="right"))
                stop = max(before, after)
            some = slice(start, stop)
            yield replace(
                self,
                observation_points=points[some],
                observation_frames=self.observation_frames[some],
                observation_bearings=self.observation_bearings[some],
                observation_sigmas=self.observation_sigmas[some],
                observation_origins=None if origins is None else origins[some],
            )
            if stop == len(points):
                return

    def taken(self, rows: np.ndarray) -> "Reconstruction":
        """Reconstruction of frames `rows` (F',), ascending: their poses and observed points."""
        if len(rows) == len(self.world_T_rigs):
            return self
        number = np.full(len(self.world_T_rigs), -1)
        number[rows] = np.arange(len(rows))
        seen = number[self.observation_frames] >= 0
        points, which = np.unique(self.observation_points[seen], return_inverse=True)
        origins = self.observation_origins
        return replace(
            self,
            world_T_rigs=self.world_T_rigs[rows],
            pose_covariances=self.pose_covariances[rows],
            pose_statuses=self.pose_statuses[rows],
            points_world=self.points_world[points],
            point_colors=self.point_colors[points],
            point_errors=self.point_errors[points],
            observation_points=which.astype(np.int32),
            observation_frames=number[self.observation_frames[seen]].astype(np.int32),
            observation_bearings=self.observation_bearings[seen],
            observation_sigmas=self.observation_sigmas[seen],
            observation_origins=None if origins is None else origins[seen],
            components=None,
            joint_errors=self.joint_errors and self.joint_errors.taken(rows),
        )
