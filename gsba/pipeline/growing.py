"""Finished runs that grow: recordings added or taken out, and runs merged, from what is solved."""

import logging
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from gsba.config import CameraSettings, GpsSettings, PlacementSettings
from gsba.disk import (
    disk_errors,
    exchange_folders,
    hold_folder,
    link_or_copy,
    with_own_name,
)
from gsba.frames.recordings import combine
from gsba.log import GsbaError
from gsba.masks.segmentation import Segment
from gsba.pipeline import backend, camera, finished_run, map_joining, outputs
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_cameras import JointCameras, as_read_by, refuse_fields
from gsba.pipeline.joint_map import JointMaps
from gsba.pipeline.map_joining import ApartError, RigidMoves
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.prior import Prior
from gsba.pipeline.recordings import Recording, names_of
from gsba.pipeline.refine import refine_each
from gsba.pipeline.stage_titles import title_of
from gsba.pipeline.state import State
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity
from gsba.store import cluster
from gsba.store.folder import STAGES, check_run_folder, is_run_folder, read_marker
from gsba.store.records import save_record
from gsba.store.store import RunStore
from gsba.trajectory.joining import PLACES, SegmentAlignment
from gsba.types import CoarsePoses, FrameSet, PoseSource, Reconstruction

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)
SCRATCH = "new"  # run of new recordings, in the folder that is being written
_FRAMES, _MASKS = "frames", "masks"  # folders of the frames and masks that runs hold themselves
_ODOMETRY = "odometry"  # folder of what the odometry of videos found


@contextmanager
def held_runs(roots: Sequence[Path]) -> Iterator[None]:
    """Keep other processes from runs in this context; GsbaError if one is missing, no run, or in
    use."""
    locks = list[int]()
    try:
        for root in roots:
            check_run_folder(root)
            locks.append(hold_folder(root))
        yield
    finally:
        for lock in locks:
            os.close(lock)


def forget_other_work(work: Path, origin: dict[str, Path], out: Path) -> None:
    """Delete what a call with other inputs has left half-written in `work`; a finished run whose
    renaming to `out` was interrupted is kept beside it."""
    if not work.exists():
        return
    lock = hold_folder(work)
    try:
        resolved = {name: str(path.resolve()) for name, path in origin.items()}
        if is_run_folder(work) and read_marker(work)["origin"] == resolved:
            return
        with disk_errors(work):
            if (work / "report.json").is_file():
                work.rename(_free_name(out))
                return
            logger.info("%s: left by another call that was interrupted, deleted", work)
            shutil.rmtree(work)
    finally:
        os.close(lock)


def complete(store: RunStore, frames: FrameSet, sources: Sequence[Path], out: Path) -> FrameSet:
    """Give a run all files that its frames and masks are read from, and no other run need hold;
    returns the frames as they are read then."""
    roots = [root.resolve() for root in sources]

    def kept(path: Path, frame: str, folder: str, lens: str = "") -> Path:
        own = path.resolve()
        if not any(root in own.parents for root in roots):
            return path
        name = Path(folder) / frame.rpartition("/")[0] / lens / path.name
        link_or_copy(own, store.root / name)
        return out.absolute() / name

    paths, masks = [], []
    for frame, group, mask in zip(frames.names, frames.paths, frames.mask_paths, strict=True):
        # pictures of several lenses have one name, in folders of theirs
        lenses = [path.parent.name if len({*group}) > 1 else "" for path in group]
        given = zip(group, lenses, strict=True)
        paths.append(tuple(kept(path, frame, _FRAMES, lens) for path, lens in given))
        masks.append(mask and kept(mask, frame, _MASKS))
    for root in roots:
        for path in sorted((root / _ODOMETRY).rglob("*")):
            if path.is_file() and root != store.root.resolve():
                link_or_copy(path, store.root / path.relative_to(root))
    for folder in (_FRAMES, _MASKS, _ODOMETRY):
        if (store.root / folder).is_dir():
            store.claim(store.root / folder)
    moved = replace(frames, paths=tuple(paths), mask_paths=tuple(masks))
    info = {"key": store.records["frames"].key} | {
        name: getattr(store.records["frames"], name)
        for name in ("name", "resumed", "seconds", "cpu_seconds", "peak_mb", "workers")
    }
    save_record(store.root / STAGES / "frames.npz", moved, info)
    return moved


def put_in_place(work: Path, out: Path) -> Path | None:
    """Rename a complete run into place; a run that was there gets the name returned."""
    with disk_errors(out):
        shutil.rmtree(work / SCRATCH, ignore_errors=True)
        if not out.exists() or not any(out.iterdir()):
            with suppress(FileNotFoundError):
                out.rmdir()
            work.rename(out)
            return None
        before = _free_name(out)
        if exchange_folders(work, out):
            work.rename(before)
        else:  # for a moment the run has its other name alone
            out.rename(before)
            work.rename(out)
        return before


def _free_name(out: Path) -> Path:
    """Name beside a run's folder under which it can be kept."""
    number, path = 1, out.with_name(f"{out.name}-before")
    while path.exists():
        number += 1
        path = out.with_name(f"{out.name}-before-{number}")
    return path


@threadpool_limits.wrap(limits=1, user_api="blas")  # sums keep their order
def add_recordings(
    run: Path | str,
    recordings: Sequence[Recording],
    out: Path | str | None = None,
    *,
    fixed: bool = False,
    segment: Segment | None = None,
    client: "Client | None" = None,
) -> RunResult:
    """Add recordings to a finished run: its map is where they start, and all is solved again.

    The recordings are refined with the settings of the run, joined to its map where they meet it,
    and tied to it by the points that both show. The run is only read until the result is complete.

    Args:
        run: folder of a finished run.
        recordings: at least one. Those of the layout, size and calibration of one of the run's
            cameras are of this camera, unless they name different models; the others have
            cameras of their own.
        out: folder of the result, new or empty; None = the folder of the run, which is kept as
            RUN-before beside it.
        fixed: keep the run's poses to the byte, and solve those of the recordings against them.
        segment, client: see `gsba.refine`.

    Raises:
        GsbaError: an input that cannot be used, or a recording that does not meet the run's map.
    """
    root = Path(run)
    if not recordings:
        raise GsbaError("give a recording to add: a folder of frames, or a video")
    with held_runs([root]):
        finished = FinishedRun.load(root)
        names = names_of(recordings)
        _refuse_known(finished, recordings, names)
        place = _place_of(root, out)
        given = {
            f"{name}: frames": Path(one.frames) for name, one in zip(names, recordings, strict=True)
        }
        with _store_beside(place, finished.origin | given, client, finished) as work:
            scratch = work.root / SCRATCH
            named = [replace(one, name=name) for one, name in zip(recordings, names, strict=True)]
            settings = finished.settings  # less what places its result
            direct = settings.direct_families()
            factors = tuple(
                name for name in settings.factors if name != "gps" and name not in direct
            )
            settings = settings.model_copy(
                update={
                    "factors": factors,
                    "gps": GpsSettings(),
                    "placement": PlacementSettings(),
                    "export": settings.export.model_copy(update={"formats": ()}),
                }
            )
            models = {one.name: one.camera for one in named}

            def adapt(found: Mapping[str, FrameSet]) -> dict[str, tuple[FrameSet, CameraSettings]]:
                combine({**finished.recordings(), **found})  # refuses recordings that the run has
                return as_read_by(finished, found, models)

            given = {"segment": segment, "client": client, "adapt": adapt}
            refine_each(named, scratch, settings, **given)
            runs = [finished, FinishedRun.load(scratch)]
            state, maps = _joined(work, runs)
            # Refuse new recordings of which no frame is in the map that is exported
            merged = state.prior.merged
            assert merged is not None
            main = merged.components[maps.main_rows(0)[0]]
            for name, rows in state.run.frames.recordings.items():
                if rows[0] >= maps.starts[1] and not (merged.components[rows] == main).any():
                    number = int(merged.components[rows].min())
                    reason = merged.reasons[number] if number < len(merged.reasons) else ""
                    raise ApartError(
                        f"recording '{name}' does not meet the map of {maps.runs[0].root}"
                        f"{f' ({reason})' if reason else ''}: nothing is added; recordings are "
                        "joined where they show the same place, over six frames or more"
                    )
            held = None
            if fixed:  # maps that the recordings join to the largest one move there
                held = np.flatnonzero(_define_worlds(maps, merged.components)[: maps.starts[1]])
                state = map_joining.hold(state, held)
            state = map_joining.tie(state, maps.parts)
            return _finish(place, work, state, maps, held=held)


@threadpool_limits.wrap(limits=1, user_api="blas")  # sums keep their order
def merge_runs(
    runs: Sequence[Path | str],
    out: Path | str,
    *,
    rigid: bool = False,
    client: "Client | None" = None,
) -> RunResult:
    """Merge finished runs into one: their maps are joined where they meet, and solved together.

    The world, the scale and the settings are those of the first run. Runs that meet no other stay
    maps of their own.

    Args:
        runs: folders of finished runs, at least two; only read. Their cameras are told apart as
            recordings' are by `add_recordings`.
        out: folder of the result, new or empty.
        rigid: move each map as it is, by a similarity whose covariance is reported.
        client: see `gsba.refine`.

    Raises:
        GsbaError: an input that cannot be used, or no two runs that meet.
    """
    roots = [Path(run) for run in runs]
    if len(roots) < 2:
        raise GsbaError("give two finished runs or more to merge")
    resolved = [root.resolve() for root in roots]
    for root, path in zip(roots, resolved, strict=True):
        if resolved.count(path) > 1:
            raise GsbaError(f"{root} is given twice: give each run once")
    place = _place_of(None, out)
    with held_runs(roots):
        finished = [FinishedRun.load(root) for root in roots]
        known: dict[Path, FinishedRun] = {}
        for run in finished:
            for path in (path for what, path in run.origin.items() if what.endswith(": frames")):
                if (other := known.setdefault(path.resolve(), run)) is not run:
                    raise GsbaError(
                        f"{other.root} and {run.root} both have recording {path}: take it out of "
                        "one (gsba remove), or merge others"
                    )
        refuse_fields(finished, len(JointCameras.of(finished).formats) > 1)
        origin = {what: path for run in finished for what, path in run.origin.items()}
        with _store_beside(place, origin, client, finished[0]) as work:
            state, maps = _joined(work, finished)
            _require_any_joined(maps, state)
            if not rigid:
                return _finish(place, work, map_joining.tie(state, maps.parts), maps)
            moves = map_joining.align_rigidly(state, maps.parts)
            state = map_joining.moved_rigidly(state, maps.parts, moves, maps.unit_frames())
            return _finish(place, work, state, maps, rigid=moves)


@threadpool_limits.wrap(limits=1, user_api="blas")  # sums keep their order
def remove_recordings(
    run: Path | str, names: Sequence[str], out: Path | str | None = None
) -> RunResult:
    """Take recordings out of a finished run: the rest is solved again from where it was.

    Points that only they saw are left out. What no points tie together any more becomes maps of
    its own.

    Args:
        run: folder of a finished run of several recordings.
        names: of recordings.
        out: folder of the result, new or empty; None = the folder of the run, which is kept as
            RUN-before beside it.

    Raises:
        GsbaError: an input that cannot be used; no such recording, or none that would be left.
    """
    root = Path(run)
    with held_runs([root]):
        finished = FinishedRun.load(root)
        # Refuse names that a run does not have, or to take out all that it has
        known = list(finished.frames.recordings)
        if not names:
            raise GsbaError(
                f"name the recordings to take out; {finished.root} has {', '.join(known)}"
            )
        for name in names:
            if name not in known:
                raise GsbaError(
                    f"{finished.root} has no recording '{name}': it has {', '.join(known)}"
                )
        if set(names) == set(known):
            raise GsbaError(
                f"{finished.root} has no other recording than {', '.join(known)}: one must stay"
            )
        left = finished.without(names)
        place = _place_of(root, out)
        with _store_beside(place, left.origin, None, left) as work:
            maps = JointMaps.of([left])
            state = map_joining.begin(work, maps, left.settings)
            return _finish(place, work, map_joining.adjust(state), maps)


def _place_of(root: Path | None, out: Path | str | None) -> Path:
    """Where the result of a run that grows is written; GsbaError if there is something."""
    if root is not None and (out is None or Path(out).resolve() == root.resolve()):
        return with_own_name(root)
    assert out is not None
    out = with_own_name(Path(out))
    if out.is_symlink() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise GsbaError(f"{out} exists: choose another --out")
    if not out.parent.is_dir():
        raise GsbaError(f"{out.parent} is no folder: make it, or choose another --out")
    return out


@contextmanager
def _store_beside(
    out: Path, origin: dict[str, Path], client: "Client | None", first: FinishedRun
) -> Iterator[RunStore]:
    """Store of the run in a folder beside its place, taken up where a call was interrupted.

    The folder is deleted where maps turn out not to be of one place.
    """
    work = out.with_name(f".{out.name}.growing")
    forget_other_work(work, origin, out)
    hired = cluster.hire(client, first.frames.paths[0][0], first.settings)
    try:
        with RunStore(work, origin, hire=hired, title_of=title_of) as store:
            yield store
    except ApartError:
        shutil.rmtree(work, ignore_errors=True)
        raise


def _finish(
    out: Path,
    store: RunStore,
    state: State,
    maps: JointMaps,
    *,
    held: np.ndarray | None = None,
    rigid: RigidMoves | None = None,
) -> RunResult:
    """Write the result and put it in place; frames `held` (H,) kept their poses, maps of `rigid`
    were moved by similarities; None = all were solved together."""
    written = _write(state, maps, held, rigid)
    frames = complete(store, state.run.frames, [*(run.root for run in maps.runs), store.root], out)
    before = put_in_place(store.root, out)
    if before is not None:
        logger.info("the run as it was: %s; delete it whenever you like", before)
    return replace(written, out=out, frames=frames)


def _joined(store: RunStore, runs: Sequence[FinishedRun]) -> tuple[State, JointMaps]:
    maps = JointMaps.of(runs)
    return map_joining.register(map_joining.begin(store, maps, runs[0].settings), maps), maps


def _refuse_known(run: FinishedRun, recordings: Sequence[Recording], names: Sequence[str]) -> None:
    """Refuse recordings that are in a run already, or whose name is taken there."""
    taken = list(run.frames.recordings)
    known = {path.resolve(): what.rpartition(": ")[0] for what, path in run.origin.items()}
    for one, name in zip(recordings, names, strict=True):
        path = Path(one.frames).resolve()
        if path in known:
            raise GsbaError(f"{run.root} has recording {path} already, as '{known[path]}'")
        if name in taken:
            raise GsbaError(
                f"{run.root} has another recording named '{name}': give {path} a name of its own "
                "(--recording PATH,name=NAME)"
            )


def _require_any_joined(maps: JointMaps, state: State) -> None:
    """Refuse runs of which none meets another."""
    merged = state.prior.merged
    assert merged is not None
    owners = np.repeat(np.arange(len(maps.runs)), np.diff(maps.starts))
    for component in np.unique(merged.components):
        if len(np.unique(owners[merged.components == component])) > 1:
            return
    reasons = [reason for reason in merged.reasons if reason]
    raise ApartError(
        f"the maps of {' and '.join(str(run.root) for run in maps.runs)} meet nowhere"
        f"{f' ({reasons[0]})' if reasons else ''}: nothing is merged; maps are joined where they "
        "show the same place, over six frames or more"
    )


def _define_worlds(maps: JointMaps, components: np.ndarray) -> np.ndarray:
    """Frames (F,) bool whose poses before define the worlds of the new maps (F,): those of the
    largest map of the first run that has any in the new one."""
    defining = np.zeros(len(components), bool)
    for component in np.unique(components):
        inside = np.flatnonzero(components == component)
        part = maps.parts[inside[0]]
        for number in range(len(maps.runs)):
            main = maps.main_rows(number)
            if np.isin(main, inside).any():
                part = maps.parts[main[0]]
                break
        defining[inside[maps.parts[inside] == part]] = True
    return defining


def _write(
    state: State, maps: JointMaps, held: np.ndarray | None, rigid: RigidMoves | None
) -> RunResult:
    """Covariances, and all that a run leaves behind; arguments as of `_finish`."""
    components = state.prior.parts
    if components is None:
        components = np.zeros(len(state.run.frames), np.int64)
    defining = _define_worlds(maps, components)
    sources = np.where(defining, PoseSource.SLAM, PoseSource.NONE).astype(np.uint8)

    def amended(result: Reconstruction) -> Reconstruction:
        first = maps.runs[0].result
        if maps.main_rows(0)[0] in result.largest_map():  # in whose world it is then
            result = replace(result, vertical=first.vertical, origin=first.origin)
        if held is not None:  # the poses of the first run stay as they were
            poses, covariances = result.world_T_rigs.copy(), result.pose_covariances.copy()
            poses[held], covariances[held] = first.world_T_rigs[held], first.pose_covariances[held]
            changes = {"world_T_rigs": poses, "pose_covariances": covariances}
            result = replace(result, joint_errors=None, **changes)
        return result if rigid is None else _with_rigid(result, state, maps, rigid)

    poses = np.concatenate([run.result.world_T_rigs for run in maps.runs])
    rows = state.run.frames.recordings.values()
    state = replace(
        state,
        prior=replace(
            state.prior,
            of_recordings=tuple(
                Prior.of(CoarsePoses(poses[own], sources[own], 0.0)) for own in rows
            ),
        ),
    )
    if held is None and rigid is None:
        state = camera.measure_camera(state)
    result = backend.reconstruct(state, amended)
    lenses = camera.keep_lenses(state, result)
    # The state as the report tells of it: trajectories before, in the worlds of the result
    poses, sources = list[np.ndarray](), list[np.ndarray]()
    joints = list[SegmentAlignment]()
    main = set(result.largest_map().tolist())
    for number, run in enumerate(maps.runs):
        rows, own = maps.main_rows(number), run.result.largest_map()
        joined = bool(main.intersection(rows.tolist()))
        move = Sim3()
        try:
            move = pose_similarity(run.result.world_T_rigs[own], result.world_T_rigs[rows])
        except NoSimilarityError:
            joined = False
        poses.append(move.poses(run.coarse.world_T_rigs))
        sources.append(run.coarse.sources)
        for name in run.frames.recordings:
            there = state.run.frames.recordings[name]
            if number and joined:
                covariance = None if rigid is None else rigid.covariances[maps.parts[rows[0]]]
                alignment = move.scale, move.new_T_old, PLACES, covariance
                joints.append(SegmentAlignment(int(there[0]), int(there[-1]), *alignment))
    coarse = CoarsePoses(np.concatenate(poses), np.concatenate(sources), 0.0)
    prior = replace(
        state.prior,
        coarse=coarse,
        joints=tuple(joints),
        order_doubted=any(run.order_doubted for run in maps.runs),
        lone_steps=tuple(step for run in maps.runs for step in run.lone_steps),
    )
    unusable = tuple(name for run in maps.runs for name in run.unusable)
    evidence = replace(state.run.evidence, blank=unusable)
    run = replace(state.run, settings=maps.runs[0].settings, evidence=evidence)
    state = replace(state, run=run, prior=prior)
    finished_run.keep(state)
    return outputs.write(state, result, lenses)


def _with_rigid(
    result: Reconstruction, state: State, maps: JointMaps, rigid: RigidMoves
) -> Reconstruction:
    """The result with the covariances that maps have alone, and those of the moves between them."""
    own, stretches = list[np.ndarray](), np.ones(len(maps.parts))
    for number, run in enumerate(maps.runs):
        own.append(run.result.pose_covariances)
        for part in np.unique(maps.parts[maps.rows(number)]):
            rows = np.flatnonzero(maps.parts == part)
            before = run.result.world_T_rigs[rows - maps.starts[number]]
            stretches[rows] = pose_similarity(before, result.world_T_rigs[rows]).scale
    covariances = rigid.pose_covariances(
        np.concatenate(own), state.solution.world_T_rigs, stretches, maps.parts
    )
    poses, first = result.world_T_rigs.copy(), maps.main_rows(0)
    poses[first] = maps.runs[0].result.world_T_rigs[maps.runs[0].result.largest_map()]
    return replace(result, world_T_rigs=poses, pose_covariances=covariances, joint_errors=None)
