"""Finished runs that grow: recordings added or taken out, and runs merged, from what is solved."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from gsba.config import GpsSettings, PlacementSettings, RefineSettings
from gsba.log import GsbaError
from gsba.masks.segmentation import Segment
from gsba.pipeline import backend, camera, finished_run, grown_folder, map_joining, outputs
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_map import JointMaps
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.prior import Prior
from gsba.pipeline.recording import Recording, names_of
from gsba.pipeline.recordings import refine_each
from gsba.pipeline.stage_titles import title_of
from gsba.pipeline.state import State
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity
from gsba.store import cluster
from gsba.store.store import RunStore
from gsba.trajectory.joining import PLACES, SegmentAlignment
from gsba.types import CoarsePoses, PoseSource, Reconstruction

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)


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
        recordings: of the run's camera in its mode, at least one.
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
    with grown_folder.held_runs([root]):
        finished = FinishedRun.load(root)
        names = names_of(recordings)
        _refuse_known(finished, recordings, names)
        place = _Place.of(root, out)
        given = {
            f"{name}: frames": Path(one.frames) for name, one in zip(names, recordings, strict=True)
        }
        with place.store(finished.origin | given, client) as work:
            scratch = grown_folder.scratch_of(work.root)
            named = [replace(one, name=name) for one, name in zip(recordings, names, strict=True)]
            settings = _settings_of_new(finished.settings)
            refine_each(named, scratch, settings, segment=segment, client=client)
            runs = [finished, FinishedRun.load(scratch)]
            state, maps = _joined(work, runs)
            _require_joined(maps, state)
            if fixed:
                state = map_joining.hold(state, maps.rows(0))
            state = map_joining.tie(state, maps.parts)
            return place.finish(work, state, maps, maps.rows(0) if fixed else None)


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a run that grows is written."""

    out: Path
    in_place: bool  # True = a run is there, which is kept under another name

    @classmethod
    def of(cls, root: Path | None, out: Path | str | None) -> "_Place":
        """A place for the result of a run that grows.

        Raises:
            GsbaError: there is something.
        """
        if root is not None and (out is None or Path(out).resolve() == root.resolve()):
            return cls(root, True)
        assert out is not None
        grown_folder.refuse_existing(Path(out))
        return cls(Path(out), False)

    def store(self, origin: dict[str, Path], client: "Client | None") -> RunStore:
        """Store of the run in a folder beside its place, taken up where a call was interrupted."""
        work = grown_folder.folder_beside(self.out)
        grown_folder.forget_other_work(work, origin)
        hired = cluster.hire(client, work, RefineSettings())
        return RunStore(work, origin, hire=hired, title_of=title_of)

    def finish(
        self, store: RunStore, state: State, maps: JointMaps, held: np.ndarray | None
    ) -> RunResult:
        """Write the result, and put it in place."""
        written = _write(state, maps, held)
        sources = [*(run.root for run in maps.runs), store.root]
        grown_folder.complete(store, state.run.frames, sources, self.out)
        before = grown_folder.put_in_place(store.root, self.out)
        if before is not None:
            logger.info("the run as it was: %s; delete it whenever you like", before)
        return replace(written, out=self.out)


def _joined(store: RunStore, runs: Sequence[FinishedRun]) -> tuple[State, JointMaps]:
    """Maps of runs moved to where they meet."""
    maps = JointMaps.of(runs)
    return map_joining.register(map_joining.begin(store, maps, runs[0].settings), maps), maps


def _settings_of_new(settings: RefineSettings) -> RefineSettings:
    """Settings of a run, for recordings that are to join it: without what places its result."""
    factors = tuple(name for name in settings.factors if name != "gps")
    return settings.model_copy(
        update={
            "factors": factors,
            "gps": GpsSettings(),
            "placement": PlacementSettings(),
            "export": settings.export.model_copy(update={"formats": ()}),
        }
    )


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
        if one.camera is not None and run.settings.camera.name not in (None, one.camera):
            raise GsbaError(
                f"recording '{name}' is of another camera than {run.root} ({one.camera} and "
                f"{run.settings.camera.name}): recordings of one run must be of one camera"
            )


def _require_joined(maps: JointMaps, state: State) -> None:
    """Refuse new recordings of which no frame is in the map that is exported."""
    merged = state.prior.merged
    assert merged is not None
    main = merged.components[maps.main_rows(0)[0]]
    for name, rows in state.run.frames.recordings.items():
        if rows[0] >= maps.starts[1] and not (merged.components[rows] == main).any():
            number = int(merged.components[rows].min())
            reason = merged.reasons[number] if number < len(merged.reasons) else ""
            raise GsbaError(
                f"recording '{name}' does not meet the map of {maps.runs[0].root}"
                f"{f' ({reason})' if reason else ''}: nothing is added; recordings are joined "
                "where they show the same place, over six frames or more"
            )


def _write(state: State, maps: JointMaps, held: np.ndarray | None) -> RunResult:
    """Covariances, and all that a run leaves behind."""
    state = replace(state, prior=replace(state.prior, of_recordings=_worlds(state, maps)))
    if held is None:
        state = camera.measure_camera(state)
    result = backend.reconstruct(state, lambda found: _with_known(found, maps, held))
    lenses = camera.keep_lenses(state, result)
    state = _told(state, maps, result)
    finished_run.keep(state)
    return outputs.write(state, result, lenses)


def _worlds(state: State, maps: JointMaps) -> tuple[Prior, ...]:
    """For each recording, the poses that define the world of the map that it is in.

    A map has the world of the first run that it has frames of.
    """
    components = state.prior.parts
    if components is None:
        components = np.zeros(len(state.run.frames), np.int64)
    sources = np.full(len(components), PoseSource.NONE, np.uint8)
    for component in np.unique(components):
        inside = np.flatnonzero(components == component)
        part = maps.parts[inside[0]]
        for number in range(len(maps.runs)):
            main = maps.main_rows(number)
            if np.isin(main, inside).any():
                part = maps.parts[main[0]]
                break
        sources[inside[maps.parts[inside] == part]] = PoseSource.SLAM
    poses = np.concatenate([run.result.world_T_rigs for run in maps.runs])
    rows = state.run.frames.recordings.values()
    return tuple(Prior.of(CoarsePoses(poses[own], sources[own], 0.0)) for own in rows)


def _with_known(result: Reconstruction, maps: JointMaps, held: np.ndarray | None) -> Reconstruction:
    """The result with the vertical of the first run, and its poses where they were held."""
    first = maps.runs[0].result
    if maps.rows(0)[0] in result.largest_map():
        result = replace(result, vertical=first.vertical)
    if held is None:
        return result
    poses, covariances = result.world_T_rigs.copy(), result.pose_covariances.copy()
    poses[held], covariances[held] = first.world_T_rigs, first.pose_covariances
    return replace(result, world_T_rigs=poses, pose_covariances=covariances, joint_errors=None)


def _told(state: State, maps: JointMaps, result: Reconstruction) -> State:
    """The state as the report tells of it: trajectories before, in the worlds of the result."""
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
                alignment = move.scale, move.new_T_old
                joints.append(SegmentAlignment(int(there[0]), int(there[-1]), *alignment, PLACES))
    coarse = CoarsePoses(np.concatenate(poses), np.concatenate(sources), 0.0)
    prior = replace(state.prior, coarse=coarse, joints=tuple(joints))
    run = replace(state.run, settings=maps.runs[0].settings)
    return replace(state, run=run, prior=prior)
