"""What is drawn of runs, in the world of the truth or in that of the first run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsba.evaluate.trajectory import PoseErrors, pose_errors
from gsba.log import GsbaError
from gsba.report.report import angular_residuals, frame_quality
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity
from gsba.store.finished import load_run
from gsba.trajectory.association import matched_in_time
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

_SAME_TIME_S = 0.01
_LEAST_COMMON = 3  # poses of one time that lay two runs on each other


@dataclass(frozen=True, slots=True)
class Shown:
    """One run, or a trajectory alone."""

    name: str
    refined: Trajectory
    coarse: Trajectory | None = None  # in the world of `refined`; None = a trajectory alone
    residuals_deg: np.ndarray | None = None  # (O,) of all observations, degrees, ascending
    frame_residuals_deg: np.ndarray | None = None  # (F,) median of each frame, NaN = none
    errors: PoseErrors | None = None  # None = there is no truth
    coarse_errors: PoseErrors | None = None
    placed: Sim3 | None = None  # into the common world; None = it could not be laid there


def load(paths: Sequence[Path], truth: Trajectory | None = None) -> tuple[Shown, ...]:
    """Read runs, and lay them on the truth, or without one on the first of them.

    Args:
        paths: folders of finished runs, or trajectory files.
        truth: true poses.

    Raises:
        GsbaError: naming what cannot be read, or has too little in common with the truth.
    """
    names = _names(paths)
    found = [_read(name, path) for name, path in zip(names, paths, strict=True)]
    if truth is None:
        return tuple(replace(one, placed=_onto(one, found[0])) for one in found)
    return tuple(_judged(one, truth) for one in found)


def _read(name: str, path: Path) -> Shown:
    if not path.is_dir():
        return Shown(name, read_trajectory(path))
    reconstruction, frames = load_run(path)
    coarse = path / "coarse.tum"
    return Shown(
        name,
        Trajectory(frames.timestamps, reconstruction.world_T_rigs),
        read_trajectory(coarse) if coarse.is_file() else None,
        np.sort(np.degrees(angular_residuals(reconstruction))),
        frame_quality(reconstruction).median_residuals_deg,
    )


def _judged(shown: Shown, truth: Trajectory) -> Shown:
    """With its errors; those of the coarse trajectory where they can be told."""
    try:
        errors = pose_errors(shown.refined, truth)
    except GsbaError as error:
        raise GsbaError(f"{shown.name}: {error}") from None
    try:
        before = None if shown.coarse is None else pose_errors(shown.coarse, truth)
    except GsbaError:
        before = None
    return replace(shown, errors=errors, coarse_errors=before, placed=errors.fit)


def _onto(shown: Shown, first: Shown) -> Sim3 | None:
    """Similarity that lays a run on the first one; None = they are of different walks."""
    rows, others = matched_in_time(shown.refined, first.refined, _SAME_TIME_S)
    if len(rows) < _LEAST_COMMON:
        return None
    try:
        return pose_similarity(shown.refined.world_T_rigs[rows], first.refined.world_T_rigs[others])
    except NoSimilarityError:
        return None


def _names(paths: Sequence[Path]) -> list[str]:
    """Short names that differ: of the folder, with more of its parents where it must be."""
    parts = [path.resolve().parts for path in paths]
    if len(set(parts)) < len(parts):
        twice = next(path for k, path in enumerate(paths) if parts[k] in parts[:k])
        raise GsbaError(f"{twice}: is named twice; name each run once")
    depth = 1
    while len({of_path[-depth:] for of_path in parts}) < len(parts):
        depth += 1
    return ["/".join(of_path[-depth:]) for of_path in parts]
