"""Figures of several runs: trajectories, errors against the truth, residuals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsba.evaluate import charts
from gsba.evaluate.trajectory import TOLERANCE_S, PoseErrors, pose_errors
from gsba.log import GsbaError
from gsba.report.html.figures import viewing_axes
from gsba.report.report import angular_residuals, frame_quality
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity
from gsba.store.finished import load_run, reported
from gsba.trajectory.association import matched_in_time, refuse_untimed
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory, rows_across

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


@dataclass(frozen=True, slots=True)
class PlottedRun:
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


def load(paths: Sequence[Path], truth: Trajectory | None = None) -> tuple[PlottedRun, ...]:
    """Read runs, and align them to the truth, or without a truth to the first run.

    Args:
        paths: folders of finished runs, or trajectory files.

    Raises:
        GsbaError: a run cannot be read, or has too few poses in common with the truth.
    """
    names = _names(paths)
    found = [_read(name, path, truth) for name, path in zip(names, paths, strict=True)]
    if truth is None:
        return tuple(replace(one, placed=_aligned_to(one, found[0])) for one in found)
    return tuple(_with_errors(one, truth) for one in found)


def _read(name: str, path: Path, truth: Trajectory | None) -> PlottedRun:
    if not path.is_dir():
        return PlottedRun(name, read_trajectory(path))
    reconstruction, frames = load_run(path)
    if truth is not None:
        refuse_untimed(frames, truth)
    coarse, start = path / "coarse.tum", reported(path, "start")
    return PlottedRun(
        name,
        Trajectory(frames.timestamps, reconstruction.world_T_rigs),
        read_trajectory(coarse) if coarse.is_file() else None,
        np.sort(np.degrees(angular_residuals(reconstruction))),
        frame_quality(reconstruction).median_residuals_deg,
        before=f"before ({start})" if start else "before",
    )


def _with_errors(shown: PlottedRun, truth: Trajectory) -> PlottedRun:
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


def _aligned_to(shown: PlottedRun, first: PlottedRun) -> Sim3 | None:
    """Similarity from a run to the first one; None = they are of different walks."""
    rows, others = matched_in_time(shown.refined, first.refined, TOLERANCE_S)
    if len(rows) < 3:
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


_WIDTH_IN, _ROW_HEIGHT_IN = 7.2, 2.7  # text width of a paper; height of a row of panels
_MAX_PANELS_PER_ROW = 3

Fill = Callable[["SubFigure | Figure"], None]


def draw(shown: Sequence[PlottedRun], out: Path, truth: Trajectory | None = None) -> list[Path]:
    """Write the figures of several runs.

    They show trajectories from above, each run in a panel; with the truth, errors of every pose
    over time and their distribution; of runs, angular residuals of frames over time and of all
    observations.

    Args:
        shown: runs from `gsba.report.plots.load`, with the same truth.
        out: folder for trajectories, errors and residuals, each as PNG and SVG; or a file (PNG,
            SVG or PDF) for all of them in one figure.

    Returns:
        the files.

    Raises:
        GsbaError: matplotlib is not installed, the file's suffix is unknown, or the disk cannot be
            written.
    """
    rows = -(-len(shown) // _MAX_PANELS_PER_ROW)
    figures: dict[str, tuple[int, Fill]] = {
        "trajectories": (rows, lambda figure: _trajectories(figure, shown, truth))
    }
    if truth is not None:
        figures["errors"] = (2, lambda figure: _errors(figure, shown))
    if any(one.residuals_deg is not None for one in shown):
        figures["residuals"] = (1, lambda figure: _residuals(figure, shown))
    if not out.suffix or out.is_dir():
        files = []
        for name, (num_rows, fill) in figures.items():
            paths = [out / f"{name}.{kind}" for kind in ("png", "svg")]
            charts.write(paths, (_WIDTH_IN, num_rows * _ROW_HEIGHT_IN), fill)
            files += paths
        return files
    if out.suffix.lower() not in charts.KINDS:
        raise GsbaError(f"--out {out}: give a .png, .svg or .pdf file, or a folder")
    heights = [num_rows for num_rows, _ in figures.values()]

    def fill_all(figure: "Figure") -> None:
        parts = figure.subfigures(len(figures), 1, height_ratios=heights, squeeze=False)[:, 0]
        for part, (_, fill) in zip(parts, figures.values(), strict=True):
            fill(part)

    charts.write([out], (_WIDTH_IN, sum(heights) * _ROW_HEIGHT_IN), fill_all)
    return [out]


def _trajectories(
    figure: "SubFigure | Figure", shown: Sequence[PlottedRun], truth: Trajectory | None
) -> None:
    """Draw trajectories from above, before and after; the truth is dotted."""
    beside = min(len(shown), _MAX_PANELS_PER_ROW)
    rows = -(-len(shown) // beside)
    panels = figure.subplots(rows, beside, squeeze=False).ravel()
    common = shown[0].refined if truth is None else truth
    unit = "units of the truth" if truth is not None else f"units of {charts.plain(shown[0].name)}"
    lines: dict[str, Any] = {}
    for one, axes in zip(shown, panels, strict=False):
        world, own = (one.refined, Sim3()) if one.placed is None else (common, one.placed)
        plan = _TopView(world)
        if one.coarse is not None:
            before = one.coarse_errors.fit if one.coarse_errors is not None else own
            lines[one.before] = plan.line(axes, one.coarse, before, charts.BEFORE, "-")
            lines["after"] = plan.line(axes, one.refined, own, charts.AFTER, "-")
        else:
            lines["trajectory"] = plan.line(axes, one.refined, own, charts.ALONE, "-")
        if truth is not None:
            lines["truth"] = plan.line(axes, truth, Sim3(), charts.TRUE, ":")
        axes.set_title(charts.plain(one.name))
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("own units" if one.placed is None else unit)
    for axes in panels[len(shown) :]:
        axes.remove()
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4)


class _TopView:
    """View from above on a trajectory, along the two level axes of report.html."""

    def __init__(self, world: Trajectory) -> None:
        finite = np.isfinite(world.world_T_rigs).all(axis=(1, 2))
        poses = world.world_T_rigs[finite]
        self._axes, _ = viewing_axes(poses)
        self._centre = np.median(poses[:, :3, 3], axis=0)

    def line(self, axes: "Axes", walk: Trajectory, placed: Sim3, color: str, style: str) -> object:
        """Draw a trajectory, transformed by `placed`, with gaps at missing poses."""
        positions = placed.points(walk.world_T_rigs[:, :3, 3])
        across, up = ((positions - self._centre) @ self._axes[:2].T).T
        return axes.plot(across, up, color=color, linestyle=style)[0]


def _errors(figure: "SubFigure | Figure", shown: Sequence[PlottedRun]) -> None:
    """Draw errors of positions (above) and rotations (below), over time and as distributions."""
    panels = figure.subplots(2, 2)
    lines: dict[str, Any] = {}
    start = min(float(one.refined.timestamps[0]) for one in shown)
    for one, color in zip(shown, charts.colors(), strict=False):
        name = charts.plain(one.name)
        kinds = [(one.coarse_errors, one.coarse, ":", f"{name}, {one.before}")]
        for errors, walk, style, label in [*kinds, (one.errors, one.refined, "-", name)]:
            if errors is None or walk is None:
                continue
            times = walk.timestamps[errors.rows] - start
            for row, off in enumerate((errors.positions, np.degrees(errors.rotations))):
                look = {"color": color, "linestyle": style}
                lines[label] = panels[row, 0].plot(times, off, **look)[0]
                panels[row, 1].plot(*_shares(off), **look)
    for row, label in enumerate(("position error, units of the truth", "rotation error, degrees")):
        panels[row, 0].set(ylabel=label, yscale="log")
        panels[row, 1].set(ylabel="share of frames", xscale="log", ylim=(0, 1), xlabel=label)
    panels[1, 0].set_xlabel("time, s")
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4)


def _residuals(figure: "SubFigure | Figure", shown: Sequence[PlottedRun]) -> None:
    """Draw angular residuals: the median of every frame over time, and the distribution of all."""
    left, right = figure.subplots(1, 2)
    lines: dict[str, Any] = {}
    common = all(one.placed is not None for one in shown)
    starts = [float(one.refined.timestamps[0]) for one in shown]
    for k, (one, color) in enumerate(zip(shown, charts.colors(), strict=False)):
        if one.residuals_deg is None or one.frame_residuals_deg is None:
            continue
        times = one.refined.timestamps - (min(starts) if common else starts[k])
        name = charts.plain(one.name)
        lines[name] = left.plot(times, one.frame_residuals_deg, color=color)[0]
        right.plot(*_shares(one.residuals_deg), color=color)
    left.set(xlabel="time, s", ylabel="median residual, degrees", ylim=(0, None))
    right.set(xlabel="residual, degrees", ylabel="share of observations", ylim=(0, 1))
    right.set_xscale("log")
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4)


def _shares(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cumulative distribution: values (P,) ascending, and the share of all that is not larger."""
    ordered = np.sort(values)
    rows = rows_across(len(ordered), 2000)
    return ordered[rows], (rows + 1) / max(len(ordered), 1)
