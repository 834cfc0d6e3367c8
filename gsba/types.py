"""Records that stages hand to one another. Arrays inside; one comment per field."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

import numpy as np

FACES = ("front", "right", "back", "left", "up", "down")


class PoseSource(IntEnum):
    """Where a frame's coarse pose came from."""

    SLAM = 0  # an entry of the trajectory file
    INTERPOLATED = 1  # between two entries
    EXTRAPOLATED = 2  # before the first or after the last entry
    NONE = 3  # there is no trajectory: a placeholder


class PoseStatus(IntEnum):
    """What became of a frame."""

    REFINED = 0  # images constrain it
    UNREFINED = 1  # matched nothing: carried by its priors alone


@dataclass(frozen=True, slots=True)
class Counts:
    """What a stage received, what it kept and why the rest was dropped."""

    received: int  # things that came in
    kept: int  # things that went on
    unit: str  # what is counted: "frames", "matches", ...
    dropped: Mapping[str, int] = field(default_factory=dict)  # reason -> how many


@dataclass(frozen=True, slots=True)
class FrameSet:
    """The captured frames on disk, in time order. No pixels are held."""

    names: tuple[str, ...]  # (F,) unique, without folder or extension
    paths: tuple[tuple[Path, ...], ...]  # (F,)(1) for "erp", (F,)(len(faces)) for "cube"
    timestamps: np.ndarray  # (F,) float64, seconds, strictly increasing
    layout: str  # "erp" (2:1 equirectangular) or "cube" (one 90-degree image per face)
    faces: tuple[str, ...]  # faces present, in FACES order; () for "erp"
    width: int  # pixels of one image (ERP or face)
    height: int  # pixels
    mask_paths: tuple[Path | None, ...]  # (F,) ERP masks, white = use; None = use all
    correction: tuple[float, ...] = ()  # of what stitching bends: coefficients of a
    # factors.SphereField, radians; panoramas and masks are read as straightened by it
    timed: bool = (
        True  # whether timestamps are times; else nothing gave them, and only order counts
    )

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Timed rig poses in one world."""

    timestamps: np.ndarray  # (N,) float64, seconds, strictly increasing
    world_T_rigs: np.ndarray  # (N, 4, 4) float64, map units


@dataclass(frozen=True, slots=True)
class CoarsePoses:
    """One coarse pose for every frame of a FrameSet."""

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, map units
    sources: np.ndarray  # (F,) uint8, PoseSource
    time_offset: float  # seconds added to frame times to reach the trajectory's clock
    segments: np.ndarray | None = None  # (F,) int32, piece of the trajectory that each frame's pose
    # is of, ascending; pieces have worlds of their own until joined; None = there is one


@dataclass(frozen=True, slots=True)
class StepNoise:
    """Standard deviations of the trajectory's steps from frame to frame."""

    rotation: float  # radians, per axis
    direction: float  # of motion, radians, per axis
    length: float  # relative


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints of one frame, face after face, the strongest of a face first."""

    pixels: np.ndarray  # (K, 2) float64, (u, v) on the owning face, corner origin
    faces: np.ndarray  # (K,) uint8, index into FACES
    bearings_rig: np.ndarray  # (K, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (K,) float64, radians, per-axis localisation noise
    descriptors: np.ndarray  # (K, D) uint8 or float32, unit length up to one common factor
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
    sqrt_infos: np.ndarray | None = None  # (N, 2, 2) 1/rad on the bearings' tangent_basis: the
    # square-root information where noise depends on the direction; None = 1 / sigmas_rad

    def bearings_of(self, frame: int) -> np.ndarray:
        """Bearings (K, 3) of one frame."""
        return self.bearings_rig[self.starts[frame] : self.starts[frame + 1]]

    def rows(self, tracks: "Tracks") -> np.ndarray:
        """Row (O,) of every observation of the tracks."""
        return self.starts[tracks.frames] + tracks.keypoints


@dataclass(frozen=True, slots=True)
class Matches:
    """Keypoint correspondences of frame pairs, stored back to back."""

    pairs: np.ndarray  # (P, 2) int32, frame indices (f0 < f1)
    offsets: np.ndarray  # (P + 1,) int64: pair p owns rows offsets[p]:offsets[p + 1]
    keypoints: np.ndarray  # (M, 2) int32, keypoint index in f0 and in f1

    def of(self, pair: int) -> np.ndarray:
        """Rows of one pair, (m, 2) int32."""
        return self.keypoints[self.offsets[pair] : self.offsets[pair + 1]]


@dataclass(frozen=True, slots=True)
class VerifiedPairs:
    """Pairs whose matches fit one relative pose that the trajectory does not contradict."""

    matches: Matches  # inliers only
    f0_T_f1s: np.ndarray  # (P, 4, 4) float64, translation of unit length
    counts: Counts  # of pairs


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of scene points, sorted by point, then by frame."""

    points: np.ndarray  # (O,) int32, point index j, non-decreasing
    frames: np.ndarray  # (O,) int32, frame index f
    keypoints: np.ndarray  # (O,) int32, keypoint index k in frame f
    num_points: int

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Scene points and the observations that agree with them."""

    points_world: np.ndarray  # (J, 3) float64, map units
    tracks: Tracks  # their observations; point indices are rows of points_world
    counts: Counts  # of tracks


@dataclass(frozen=True, slots=True)
class Sighted:
    """Observations made anew by aligning patches, former ones where that failed, their tracks."""

    keypoints: Keypoints  # one for each observation
    aligned: np.ndarray  # (N,) bool, which of them are new
    tracks: Tracks
    counts: Counts  # of observations


@dataclass(frozen=True, slots=True)
class JointErrors:
    """What errors of several poses have in common; tangents as those of their covariances."""

    neighbours: np.ndarray  # (F - 1, 6, 6) float64, E[x_f x_(f+1)^T], NaN = none
    draws: np.ndarray  # (D, F, 6) float32, drawn from the joint distribution of all, NaN = none

    def scaled(self, factors: np.ndarray) -> "JointErrors":
        """With each pose's errors times its factors (F, 6)."""
        neighbours = factors[:-1, :, None] * self.neighbours * factors[1:, None, :]
        return JointErrors(neighbours, (self.draws * factors).astype(np.float32))

    def taken(self, rows: np.ndarray) -> "JointErrors":
        """Of some poses (F',), ascending; those between which others are left out are no more."""
        near = (np.diff(rows) == 1)[:, None, None]
        neighbours = np.where(near, self.neighbours[rows[:-1]], np.nan)
        return JointErrors(neighbours, self.draws[:, rows])


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """Refined poses and cloud: what exports and reports are made from."""

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
    correction: tuple[float, ...] = ()  # of the frames, which these bearings have: see FrameSet
    components: np.ndarray | None = None  # (F,) int32, map that each frame is in, 0 = the largest:
    # nothing ties one map to another, each has a world of its own; None = there is one
    joint_errors: JointErrors | None = None  # those whose own covariances are above; None = none
