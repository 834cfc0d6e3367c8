"""A finished run as other runs start from it: its recordings, its map, and the world of its
result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsba.bundle.reconstruction import world_scale
from gsba.config import CameraSettings, RefineSettings
from gsba.config_file import load_config
from gsba.frames.recordings import own_timestamps
from gsba.localization.run_map import FEATURE_STAGES, require_own_version
from gsba.log import GsbaError
from gsba.loop_closure.connectivity import by_size
from gsba.pipeline.map import Map
from gsba.pipeline.state import State
from gsba.similarity import Sim3
from gsba.store.finished import load_run
from gsba.store.folder import STAGES, read_marker
from gsba.store.store import load_stage
from gsba.types import CoarsePoses, FrameSet, Landmarks, Reconstruction, Solution, cameras_of

_STAGE = "map"
_CAMERAS = "camera_settings"  # of runs of several cameras, JSON of each
_MIN_SHARED_POINTS = 12  # least points that two recordings share, to be tied to one another


@dataclass(frozen=True, slots=True)
class KeptMap:
    """The map at the end of a run, in the solution's world and unit."""

    map: Map
    coarse: CoarsePoses  # of its frames, in the world of the result
    order_doubted: bool = False  # see `pipeline.tour.check_order`
    lone_steps: tuple[tuple[str, str], ...] = ()  # the same
    unusable: tuple[str, ...] = ()  # names of frames, see `pipeline.unusable_frames`


def keep(state: State) -> None:
    """Store the map of a run at its end, for runs that start from it."""
    map_ = state.map
    if map_.stitching is not None:  # of its stage, only the field is used again
        start = map_.solution.world_T_rigs
        field = replace(
            map_.stitching,
            adjustment=Solution.without_points(start),
            keypoints=map_.observed.of_frames(np.zeros(0, np.int64)),
        )
        map_ = replace(map_, stitching=field)
    prior = state.prior
    doubts = prior.order_doubted, prior.lone_steps, state.run.evidence.unusable
    kept = KeptMap(map_, prior.coarse, *doubts)
    state.run.stage(_STAGE, [], lambda: kept, KeptMap, noted=False)
    if settings := tuple(one.model_dump_json() for one in state.run.camera_settings):
        state.run.stage(_CAMERAS, [], lambda: settings, tuple[str, ...], noted=False)


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """A finished run, or some of its frames."""

    root: Path  # its folder
    origin: dict[str, Path]  # inputs by what they are: "RECORDING: frames", ...
    frames: FrameSet  # as read, named RECORDING/NAME
    map: Map  # in the solution's world and unit
    coarse: CoarsePoses  # before refining, in the world of the result
    result: Reconstruction  # all maps, each in its own world
    settings: RefineSettings
    files: tuple[Path, ...]  # (F,) stored features of each frame; may be missing
    camera_settings: tuple[CameraSettings, ...]  # (C,)
    order_doubted: bool = False  # see `pipeline.tour.check_order`
    lone_steps: tuple[tuple[str, str], ...] = ()  # names of frames, see `pipeline.tour.check_order`
    unusable: tuple[str, ...] = ()  # names of frames, see `pipeline.unusable_frames`

    @classmethod
    def load(cls, root: Path) -> "FinishedRun":
        """Read a finished run; GsbaError for one that is not finished, of another version of gsba,
        or without points."""
        require_own_version(root)
        if not (root / "report.json").is_file():
            raise GsbaError(f"{root} is not finished: run gsba refine with --out {root} to the end")
        load_run(root)  # checks its arrays
        result = load_stage(root, "reconstruction", Reconstruction)
        frames, kept = load_stage(root, "frames", FrameSet), load_stage(root, _STAGE, KeptMap)
        if not len(result.points_world):
            raise GsbaError(f"{root} has no points (its camera turned on the spot): it cannot grow")
        num, points = len(frames), len(kept.map.solution.landmarks.points_world)
        if len(kept.map.solution.world_T_rigs) != num or points != len(result.points_world):
            raise GsbaError(f"{root}: its results do not fit together: refine again with --fresh")
        stages = [root / STAGES / stage for stage in FEATURE_STAGES]
        each = [[stage / f"{name}.npz" for stage in stages] for name in frames.names]
        files = tuple(next(filter(Path.is_file, paths), paths[-1]) for paths in each)
        origin = {what: Path(path) for what, path in read_marker(root)["origin"].items()}
        settings = load_config(root / "config.toml")
        lone, unusable = kept.lone_steps, kept.unusable
        if not frames.recordings:
            path = origin.get("frames", root)
            name = (path.stem if path.is_file() else path.name) or "frames"
            origin = {f"{name}: {what}": path for what, path in origin.items()}
            frames = replace(
                frames,
                names=tuple(f"{name}/{own}" for own in frames.names),
                clock_shifts=(0.0,) * num,
            )
            lone = tuple((f"{name}/{a}", f"{name}/{b}") for a, b in lone)
            unusable = tuple(f"{name}/{own}" for own in unusable)
        given = frames, kept.map, kept.coarse, result
        cameras = settings.camera, *([settings.camera] * (len(frames.formats) - 1))
        if len(cameras) > 1:
            known = load_stage(root, _CAMERAS, tuple[str, ...])
            cameras = tuple(CameraSettings.model_validate_json(one) for one in known)
        doubts = kept.order_doubted, lone, unusable
        return cls(root, origin, *given, settings, files, cameras, *doubts)

    def recordings(self) -> dict[str, FrameSet]:
        """Frames of each recording by its name, on its own clock, under their own names."""
        times, found = own_timestamps(self.frames), {}
        for name, rows in self.frames.recordings.items():
            own = self.frames.taken(rows)
            names = tuple(one.rpartition("/")[2] for one in own.names)
            found[name] = replace(own, names=names, timestamps=times[rows], clock_shifts=())
        return found

    def to_result(self) -> Sim3:
        """Similarity from the world of the solution to that of the result's largest map."""
        solved, row = self.map.solution.world_T_rigs, int(self.result.largest_map()[0])
        start, end = solved[row], self.result.world_T_rigs[row]
        scale = world_scale(self.map.solution, self.result)
        rotation = end[:3, :3] @ start[:3, :3].T
        return Sim3(scale, rotation, end[:3, 3] - scale * rotation @ start[:3, 3])

    def without(self, names: Sequence[str]) -> "FinishedRun":
        """The run without some of its recordings: points that others do not see are left out.

        Recordings of a map that share no points any more are maps of their own then.
        """
        owners = np.array([name.rpartition("/")[0] for name in self.frames.names])
        rows = np.flatnonzero(~np.isin(owners, list(names)))
        heads = tuple(f"{name}: " for name in names)
        origin = {what: path for what, path in self.origin.items() if not what.startswith(heads)}
        frames, map_ = self.frames.taken(rows), _map_of(self.map, rows)
        used, _ = cameras_of(self.frames.camera_of_frame, rows)
        cameras = tuple(self.camera_settings[c] for c in used)
        settings = self.settings
        if len(cameras) < len(self.camera_settings):  # those of a model that is left
            known = next((one for one in cameras if one.baseline() is not None), cameras[0])
            settings = settings.model_copy(update={"camera": known})
        return replace(
            self,
            settings=settings,
            camera_settings=cameras,
            origin=origin,
            frames=frames,
            map=map_,
            coarse=self.coarse.taken(rows),
            result=_result_of(self.result, rows, _tied(map_, frames)),
            files=tuple(self.files[f] for f in rows),
            unusable=tuple(u for u in self.unusable if u.rpartition("/")[0] not in names),
        )


def _tied(map_: Map, frames: FrameSet) -> np.ndarray:
    """Number (F,) of the group of recordings, tied by points, that each frame is of."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    owners = np.unique([name.rpartition("/")[0] for name in frames.names], return_inverse=True)[1]
    tracks = map_.solution.landmarks.tracks
    points_seen = np.unique(np.column_stack([owners[tracks.frames], tracks.points]), axis=0)
    shape = int(owners.max()) + 1, tracks.num_points
    seen = coo_matrix((np.ones(len(points_seen)), points_seen.T), shape).tocsr()
    shared = (seen @ seen.T).toarray() >= _MIN_SHARED_POINTS
    return connected_components(shared, directed=False)[1][owners]


def _result_of(result: Reconstruction, rows: np.ndarray, groups: np.ndarray) -> Reconstruction:
    """Result of frames `rows` (F',); groups (F',) of one map are maps of their own now."""
    num, scales = len(result.world_T_rigs), result.map_scales
    own = (np.zeros(num, np.int32) if result.components is None else result.components)[rows]
    components = by_size(np.unique(np.column_stack([own, groups]), axis=0, return_inverse=True)[1])
    first = np.unique(components, return_index=True)[1]
    ratios = np.ones(len(first)) if scales is None else scales[own[first]] / scales[own[first[0]]]
    several, same_world = len(first) > 1, own[first[0]] == 0
    return replace(
        result.taken(rows),
        components=components.astype(np.int32) if several else None,
        map_scales=ratios if several else None,
        vertical=result.vertical if same_world else None,
        origin=result.origin if same_world else None,
    )


def _map_of(map_: Map, rows: np.ndarray) -> Map:
    """The map of frames `rows` (F',), ascending, with the points that two of them or more see."""
    solution, observed = map_.solution, map_.observed
    tracks = solution.landmarks.tracks
    number = np.full(len(solution.world_T_rigs), -1)
    number[rows] = np.arange(len(rows))
    seen = tracks.seen_twice(number[tracks.frames] >= 0)
    points = np.unique(tracks.points[seen])
    kept = tracks.of_observations(seen)
    kept = replace(kept, frames=number[kept.frames].astype(np.int32))
    counts = replace(solution.counts, kept=len(points))
    landmarks = Landmarks(solution.landmarks.points_world[points], kept, counts)
    chosen = number[observed.frames()] >= 0
    used, of_frame = cameras_of(map_.of_frame, rows)
    return replace(
        map_,
        solution=replace(
            solution,
            world_T_rigs=solution.world_T_rigs[rows],
            landmarks=landmarks,
            rounds=(),
            variables=None,
        ),
        observed=observed.of_frames(rows),
        frame_weights=map_.frame_weights[rows],
        aligned=None if map_.aligned is None else map_.aligned[chosen],
        normals_rig=None if map_.normals_rig is None else map_.normals_rig[chosen],
        cameras=tuple(map_.cameras[c].taken(rows) for c in used),
        of_frame=of_frame,
        covariances=None,
        moves=(),
    )
