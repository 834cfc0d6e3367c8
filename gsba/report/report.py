"""report.json and poses.csv: settings, costs, results and accuracy of a run."""

import dataclasses
import logging
import math
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from gsba.bundle.triangulation import points_under
from gsba.disk import write_csv
from gsba.geometry import angular_errors, moved_to, quaternion_from_rotation
from gsba.memory import processor_name, release_mapped_files, total_memory_bytes, usable_cpus
from gsba.report.maps import summarize_maps
from gsba.report.verdict import judge
from gsba.store.store import StageRecord
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    PoseSource,
    PoseStatus,
    Reconstruction,
    RunStart,
)
from gsba.version import __version__

logger = logging.getLogger(__name__)

_PACKAGES = ("gtsam", "numpy", "numba", "scipy", "opencv-python-headless", "pycolmap")
_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")  # of a pose covariance


def source_name(pose: int, start: str) -> str:
    """Name of the source of a frame's initial pose; pose: a `PoseSource`."""
    if pose in (PoseSource.SLAM, PoseSource.NONE):
        return start
    return PoseSource(pose).name.lower()


@dataclasses.dataclass(frozen=True, slots=True)
class FrameQuality:
    """Observations, residuals and standard deviations of each pose."""

    num_observations: np.ndarray  # (F,) int64
    median_residuals_deg: np.ndarray  # (F,) float64, degrees; NaN without observations
    std_rotations_deg: np.ndarray  # (F, 3) float64, degrees, rig axes; NaN where unknown
    std_translations: np.ndarray  # (F, 3) float64, map units, rig axes; NaN where unknown


def frame_quality(reconstruction: Reconstruction) -> FrameQuality:
    """Observations, angular residuals and standard deviations of every frame."""
    frames = reconstruction.observation_frames
    num_frames = len(reconstruction.world_T_rigs)
    residuals = angular_residuals(reconstruction)
    counts = np.bincount(frames, minlength=num_frames)
    medians = np.degrees(medians_by_group(residuals, frames, num_frames))
    variances = np.diagonal(reconstruction.pose_covariances, axis1=1, axis2=2)
    deviations = np.sqrt(np.where(variances >= 0, variances, np.nan))
    return FrameQuality(counts, medians, np.degrees(deviations[:, :3]), deviations[:, 3:])


def median_residual_deg(reconstruction: Reconstruction, world_T_rigs: np.ndarray) -> float:
    """Median angular residual in degrees of the reconstruction's observations under other poses.

    Each point is triangulated again from the rays of its observations. NaN without observations.
    """
    if len(reconstruction.observation_frames) == 0:
        return math.nan
    placed = points_under(reconstruction, world_T_rigs)
    moved = dataclasses.replace(reconstruction, world_T_rigs=world_T_rigs, points_world=placed)
    return float(np.degrees(np.median(angular_residuals(moved))))


def angular_residuals(reconstruction: Reconstruction) -> np.ndarray:
    """Angles (O,) in radians between each observed bearing and the direction to its point."""
    found, done = np.empty(len(reconstruction.observation_frames)), 0
    for some in reconstruction.pieces():
        poses = moved_to(some.world_T_rigs[some.observation_frames], some.observation_origins)
        points = some.points_world[some.observation_points]
        errors = angular_errors(poses, points, some.observation_bearings)
        found[done : done + len(errors)] = errors
        done += len(errors)
        release_mapped_files()
    return found


@dataclasses.dataclass(frozen=True, slots=True)
class Findings:
    """What a run found beside poses and points, each as a section of report.json."""

    notes: Sequence[str] = ()  # for the user: frames without images, unmatched frames, ...
    trajectory: Mapping[str, Any] | None = None  # checks by images, see `findings.of_trajectory`
    stitching: Mapping[str, Any] | None = None  # its field, see `findings.of_field`
    camera: Mapping[str, Any] | None = None  # two lenses, see `camera_findings.of_camera`
    gyro: Mapping[str, Any] | None = None  # see `imu_findings.of_gyro`
    gps: Mapping[str, Any] | None = None  # see `gps_factors.GpsFactors.report`
    moves: Sequence[object] = ()  # of the poses by a splat, see `gsba.splat.refinement.PoseMove`
    recordings: Sequence[Mapping[str, Any]] = ()  # see `recordings.of_recordings`
    frame_lists: Mapping[str, Sequence[str]] = dataclasses.field(
        default_factory=dict
    )  # names of frames with a finding, see `findings.of_frames`
    reasons: Sequence[str] = ()  # why maps were not joined, see `maps.summarize_maps`
    start: str = RunStart.TRAJECTORY  # what the run started from
    order_doubted: bool = False  # see `pipeline.tour.check_order`
    lone_steps: Sequence[tuple[str, str]] = ()  # the same


@dataclasses.dataclass(frozen=True, slots=True)
class StageLog:
    """What the stages of a run cost, received and kept."""

    costs: Sequence[StageRecord] = ()  # in order
    counts: Mapping[str, Sequence[Counts]] = dataclasses.field(
        default_factory=dict
    )  # by stage name
    solver: Sequence[object] = ()  # a record for each round, with its iterations' cost by family
    seconds_again: float = 0.0  # of stages that were computed again later, and are in no row


def build_report(
    settings: BaseModel,
    frames: FrameSet,
    coarse: CoarsePoses,
    reconstruction: Reconstruction,
    stages: StageLog,
    gauge: str,
    found: Findings,
) -> dict[str, Any]:
    """Content of report.json: plain values only.

    Args:
        gauge: a sentence on the gauge of the refined map.
    """
    quality, numbers = frame_quality(reconstruction), reconstruction.map_numbers()
    rows, main = reconstruction.largest_map(), reconstruction.of_map(1)
    shown, residuals = frames.taken(rows), np.degrees(angular_residuals(main))
    lengths = np.bincount(main.observation_points, minlength=len(main.points_world))
    optional: dict[str, Any] = {"camera": found.camera, "gyro": found.gyro, "gps": found.gps}
    optional["recordings"] = found.recordings or None
    report = {
        "gsba": __version__,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "start": found.start,
        "timed": frames.timed,
        "order_doubted": found.order_doubted,
        "lone_steps": found.lone_steps,
        "summary": {
            "frames": len(frames),
            "exported": len(shown),
            "refined": np.count_nonzero(main.pose_statuses == PoseStatus.REFINED),
            "maps": reconstruction.num_maps,
            "frames_in_other_maps": np.count_nonzero(numbers > 1),
            "frames_in_no_map": np.count_nonzero(numbers == 0),
            "fetched": np.count_nonzero(shown.fetched),
            "frames_fetched": np.count_nonzero(frames.fetched),
            "frames_unusable": len(found.frame_lists.get("unusable", ())),
            "points": len(main.points_world),
            "observations": len(residuals),
            "mean_track_length": lengths.mean() if len(lengths) else math.nan,
            "median_residual_deg": np.median(residuals) if len(residuals) else math.nan,
            "median_residual_deg_coarse": median_residual_deg(main, coarse.world_T_rigs[rows]),
            "seconds": stages.seconds_again + sum(stage.seconds for stage in stages.costs),
        },
        "maps": summarize_maps(reconstruction, frames, found.reasons),
        "gauge": gauge,
        "notes": found.notes,
        "trajectory": found.trajectory,
        "stitching": found.stitching,
        **{name: section for name, section in optional.items() if section is not None},
        "stages": [
            {**dataclasses.asdict(stage), "counts": stages.counts.get(stage.name, ())}
            for stage in stages.costs
        ],
        "solver": stages.solver,
        "splat": found.moves,
        "frame_lists": found.frame_lists,
        "frames": [
            {
                "name": name,
                "status": PoseStatus(reconstruction.pose_statuses[f]).name.lower(),
                "coarse_pose": source_name(coarse.sources[f], found.start),
                "observations": quality.num_observations[f],
                "median_residual_deg": quality.median_residuals_deg[f],
                "std_rotation_deg": np.linalg.norm(quality.std_rotations_deg[f]),
                "std_translation": np.linalg.norm(quality.std_translations[f]),
            }
            for f, name in enumerate(frames.names)
        ],
        "settings": settings,
        "machine": _machine(),
        "versions": {name: _version(name) for name in _PACKAGES},
    }
    report = plain(report)
    return report | {"verdict": plain(judge(report, main, shown).to_json())}


def write_poses(
    path: Path,
    frames: FrameSet,
    coarse: CoarsePoses,
    reconstruction: Reconstruction,
    start: str = RunStart.TRAJECTORY,
) -> None:
    """Write poses.csv: world_T_rig, its quality and its covariance for every frame.

    Covariances are of the tangent [rotation (radians), translation (map units)] in the rig frame;
    the upper triangle is written row by row. Cells of unknown values are empty. Frames of the same
    `map` share a world; map 1 is the largest; the cell is empty for frames in no map. `fetched` is
    1 for frames that were added to strengthen the map and are in no dataset, see `FrameSet`.
    `source` says where a frame's initial pose is from: `start`, which the run started from, or
    interpolated or extrapolated from that.
    """
    quality = frame_quality(reconstruction)
    rows, columns = np.triu_indices(6)
    poses = reconstruction.world_T_rigs
    wxyz = quaternion_from_rotation(poses[:, :3, :3])
    numbers = np.hstack(
        [
            poses[:, :3, 3],
            wxyz,
            quality.std_rotations_deg,
            quality.std_translations,
            reconstruction.pose_covariances[:, rows, columns],
        ]
    )
    maps = reconstruction.map_numbers()
    header = ["frame", "timestamp", "status", "source", "num_observations", "median_residual_deg"]
    header += ["tx", "ty", "tz", "qw", "qx", "qy", "qz"]
    header += [f"std_{axis}_deg" for axis in _AXES[:3]] + [f"std_{axis}" for axis in _AXES[3:]]
    header += [f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(rows, columns, strict=True)]
    header += ["map", "fetched"]
    table = []
    for f, name in enumerate(frames.names):
        status = PoseStatus(reconstruction.pose_statuses[f]).name.lower()
        row = [name, repr(float(frames.timestamps[f])), status]
        row += [source_name(coarse.sources[f], start), int(quality.num_observations[f])]
        values = [quality.median_residuals_deg[f], *numbers[f]]
        row += [f"{value:.12g}" if math.isfinite(value) else "" for value in values]
        table.append([*row, int(maps[f]) or "", int(frames.fetched[f]) if frames.fetched else 0])
    write_csv(path, header, table)


def _machine() -> dict[str, Any]:
    return {
        "platform": platform.platform(),
        "processor": processor_name(),
        "cpus": usable_cpus(),
        "memory_mb": round(total_memory_bytes() / 2**20),
        "python": platform.python_version(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def plain(value: Any, digits: int = 17) -> Any:
    """Value as JSON can hold it: floats with `digits`, null for numbers that are not finite."""
    kind = type(value)  # the most frequent ones first
    if kind is float:
        if not math.isfinite(value):
            return None
        return value if digits >= 17 else float(f"{value:.{digits}g}")
    if kind in (int, str, bool, type(None)):  # JSON holds them as they are
        return value
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            entry.name: plain(getattr(value, entry.name), digits)
            for entry in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): plain(item, digits) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain_array(np.asarray(value), digits)
    if isinstance(value, Enum):
        return value.value
    return str(value) if isinstance(value, Path) else value


def _plain_array(values: np.ndarray, digits: int) -> Any:
    """An array as `plain` gives its list, without a call for each number."""
    if values.dtype.kind in "biu":
        return values.tolist()
    if values.dtype.kind != "f" or not np.isfinite(values).all():
        return plain(values.tolist(), digits)
    if digits < 17:
        rounded = [float(f"{value:.{digits}g}") for value in values.ravel().tolist()]
        values = np.array(rounded).reshape(values.shape)
    return values.tolist()


def medians_by_group(
    values: np.ndarray, groups: np.ndarray, num_groups: int, least: int = 1
) -> np.ndarray:
    """Median (G,) float64 of the values of each group; NaN for groups with fewer than `least`.

    Args:
        values: (N,).
        groups: (N,) integers, group of each value.
        num_groups: G.
        least: values that a group needs, at least one.
    """
    counts = np.bincount(groups, minlength=num_groups)
    ordered = values[np.lexsort((values, groups))]  # NaN last in its group
    large = np.flatnonzero(counts >= least)
    ends, counts = np.cumsum(counts)[large], counts[large]
    middle = np.stack([ordered[ends - counts // 2 - 1], ordered[ends - (counts + 1) // 2]])
    found = np.full(num_groups, np.nan)
    found[large] = np.where(np.isnan(ordered[ends - 1]), np.nan, middle.mean(axis=0))
    return found
