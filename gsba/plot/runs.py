"""Runs for figures, in the world of the truth or in that of the first run."""

import json
from collections.abc import Sequence
from contextlib import suppress
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

_TOLERANCE_S = 0.01  # largest time between poses of two runs that correspond
_MIN_COMMON_POSES = 3  # to align two runs


@dataclass(frozen=True, slots=True)
class Shown:
    """Run, or trajectory file, for figures."""

    name: str
    refined: Trajectory
    coarse: Trajectory | None = None  # in the world of `refined`; None = a trajectory file
    residuals_deg: np.ndarray | None = None  # (O,) of all observations, degrees, ascending
    frame_residuals_deg: np.ndarray | None = None  # (F,) median of each frame, NaN = none
    errors: PoseErrors | None = None  # None = there is no truth
    coarse_errors: PoseErrors | None = None
    placed: Sim3 | None = None  # similarity to the common world; None = it could not be aligned
    before: str = "before"  # name of `coarse` in legends: what the run started from


def load(paths: Sequence[Path], truth: Trajectory | None = None) -> tuple[Shown, ...]:
    """Read runs, and align them to the truth, or without a truth to the first run.

    Args:
        paths: folders of finished runs, or trajectory files.
        truth: true poses.

    Raises:
        GsbaError: a run cannot be read, or has too few poses in common with the truth.
    """
    names = _names(paths)
    found = [_read(name, path) for name, path in zip(names, paths, strict=True)]
    if truth is None:
        return tuple(replace(one, placed=_aligned_to(one, found[0])) for one in found)
    return tuple(_with_errors(one, truth) for one in found)


def _read(name: str, path: Path) -> Shown:
    if not path.is_dir():
        return Shown(name, read_trajectory(path))
    reconstruction, frames = load_run(path)
    coarse, start = path / "coarse.tum", ""
    with suppress(OSError, ValueError, KeyError):  # of an older run
        start = f" ({json.loads((path / 'report.json').read_text(encoding='utf-8'))['start']})"
    return Shown(
        name,
        Trajectory(frames.timestamps, reconstruction.world_T_rigs),
        read_trajectory(coarse) if coarse.is_file() else None,
        np.sort(np.degrees(angular_residuals(reconstruction))),
        frame_quality(reconstruction).median_residuals_deg,
        before=f"before{start}",
    )


def _with_errors(shown: Shown, truth: Trajectory) -> Shown:
    """Run with its errors, and those of its coarse trajectory if they can be computed."""
    try:
        errors = pose_errors(shown.refined, truth)
    except GsbaError as error:
        raise GsbaError(f"{shown.name}: {error}") from None
    try:
        before = None if shown.coarse is None else pose_errors(shown.coarse, truth)
    except GsbaError:
        before = None
    return replace(shown, errors=errors, coarse_errors=before, placed=errors.fit)


def _aligned_to(shown: Shown, first: Shown) -> Sim3 | None:
    """Similarity from a run to the first one; None = they are of different walks."""
    rows, others = matched_in_time(shown.refined, first.refined, _TOLERANCE_S)
    if len(rows) < _MIN_COMMON_POSES:
        return None
    try:
        return pose_similarity(shown.refined.world_T_rigs[rows], first.refined.world_T_rigs[others])
    except NoSimilarityError:
        return None


def _names(paths: Sequence[Path]) -> list[str]:
    """Short distinct names: the folder's, with as many parents as needed."""
    parts = [path.resolve().parts for path in paths]
    if len(set(parts)) < len(parts):
        twice = next(path for k, path in enumerate(paths) if parts[k] in parts[:k])
        raise GsbaError(f"{twice} is given twice: give each run once")
    depth = 1
    while len({of_path[-depth:] for of_path in parts}) < len(parts):
        depth += 1
    return ["/".join(of_path[-depth:]) for of_path in parts]
