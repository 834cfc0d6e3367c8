"""Maps of finished runs laid back to back as one state, which nothing ties together yet.

Every run's map is carried to the world of its result. All are seen by one camera: that of the run
which knows most of it; lengths of the others are such that lenses are as far apart.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.lens_centres import LensCentres, StitchRadius
from gsba.bundle.readout import CameraEstimate, velocities
from gsba.camera.lens import Lenses
from gsba.frames.recordings import combine, own_timestamps
from gsba.log import GsbaError
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.map import FoundCamera, Map
from gsba.similarity import Sim3
from gsba.types import Counts, FrameSet, Keypoints, Landmarks, PictureFormat, Solution, Tracks


@dataclass(frozen=True, slots=True)
class JointMaps:
    """Frames and maps of several runs, one run after the other."""

    runs: tuple[FinishedRun, ...]
    moves: tuple[Sim3, ...]  # of each run, from its solution's world to the one that it has here
    starts: tuple[int, ...]  # first frame of each run, and the number of all
    frames: FrameSet
    map: Map  # each part in a world of its own
    parts: np.ndarray  # (F,) int64, part of each frame: maps of a run are parts of their own
    seen_by: int  # run whose camera it is

    @classmethod
    def of(cls, runs: Sequence[FinishedRun]) -> "JointMaps":
        """Lay the maps of runs back to back.

        Raises:
            GsbaError: runs that cannot be one: of different cameras, features or faces, with
                recordings of one name, or with one recording twice.
        """
        _check_settings(runs)
        frames = _frames_of(runs)
        starts = (0, *np.cumsum([len(run.frames) for run in runs]).tolist())
        seen_by = _best_camera(runs)
        moves = _moves(runs)
        solutions = [_moved(run, move) for run, move in zip(runs, moves, strict=True)]
        observed = [_in_one_noise(run) for run in runs]
        keypoints = joined_keypoints([one for one, _ in observed])
        aligned = np.concatenate([confirmed for _, confirmed in observed])
        solution = _back_to_back(solutions, starts)
        parts = _parts_of(runs)
        known, scale = runs[seen_by].map, moves[seen_by].scale
        if len(known.cameras) > 1:  # no other run can be joined to it
            cameras = tuple(_in_unit(one, _scaled(one, scale), scale) for one in known.cameras)
        else:
            camera = _camera(runs, moves, solution, frames, seen_by)
            cameras = (_in_unit(known.only, camera, scale),)
        map_ = Map(
            solution,
            keypoints,
            np.concatenate([run.map.frame_weights for run in runs]),
            aligned,
            np.concatenate([_normals(run) for run in runs]),
            known.stitching,
            cameras,
            frames.camera_of_frame,
        )
        return cls(tuple(runs), moves, starts, frames, map_, parts, seen_by)

    def rows(self, number: int) -> np.ndarray:
        """Frames (F',) int64 of a run."""
        return np.arange(self.starts[number], self.starts[number + 1])

    def main_rows(self, number: int) -> np.ndarray:
        """Frames (F',) int64 of the largest map of a run."""
        return self.starts[number] + self.runs[number].result.largest_map()


def joined_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Keypoints of several sequences of frames, one sequence after the other."""
    sizes = np.concatenate([np.diff(part.starts) for part in parts])
    infos = None
    if any(part.sqrt_infos is not None for part in parts):
        infos = np.concatenate([part.roots() for part in parts])
    return Keypoints(
        np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.faces for part in parts]),
        np.concatenate([part.bearings_rig for part in parts]),
        np.concatenate([part.sigmas_rad for part in parts]),
        np.concatenate([part.colors for part in parts]),
        infos,
    )


def check_grows(run: FinishedRun) -> None:
    """Refuse a run that no other can be joined to.

    Raises:
        GsbaError: it is of raw fisheyes, or of several cameras.
    """
    if len(run.frames.formats) > 1:
        raise GsbaError(
            f"{run.root} has recordings of several cameras: refine all recordings together "
            "(gsba refine A B --out RUN)"
        )
    if run.frames.format.fisheyes is not None:
        raise GsbaError(
            f"{run.root} is of raw fisheyes, each of whose runs has a calibration of its own: "
            "refine all recordings together (gsba refine A B --out RUN)"
        )


def check_new(run: FinishedRun, found: Mapping[str, FrameSet]) -> None:
    """Refuse recordings that a run has already, or that another camera or mode has made.

    Args:
        run: a finished run.
        found: frames of the recordings by their names.

    Raises:
        GsbaError: there is one; the message names it.
    """
    combine({**run.recordings(), **found})
    for name, frames in found.items():
        _refuse_other_format(f"recording '{name}'", frames.format, run)


def _check_settings(runs: Sequence[FinishedRun]) -> None:
    """Refuse runs whose features cannot be compared."""
    first = runs[0].settings
    for run in runs[1:]:
        for name in ("features", "cubemap"):
            if getattr(run.settings, name) != getattr(first, name):
                raise GsbaError(
                    f"{run.root} has other settings of [{name}] than {runs[0].root}: refine it "
                    f"with --config {runs[0].root / 'config.toml'}"
                )


def _frames_of(runs: Sequence[FinishedRun]) -> FrameSet:
    """Frames of all runs, one recording after the other."""
    recordings: dict[str, FrameSet] = {}
    for run in runs:
        for name, own in run.recordings().items():
            if name in recordings:
                raise GsbaError(
                    f"{run.root} has a recording named '{name}', and so has a run before it: "
                    "refine one of them under another name (--recording PATH,name=NAME)"
                )
            recordings[name] = own
    frames = combine(recordings)
    for run in runs if len(runs) > 1 else ():
        check_grows(run)
        _refuse_other_format(str(run.root), run.frames.format, runs[0])
    fetched = [flag for run in runs for flag in run.frames.fetched or (False,) * len(run.frames)]
    return replace(frames, fetched=tuple(fetched) if any(fetched) else ())


def _refuse_other_format(name: str, own: PictureFormat, run: FinishedRun) -> None:
    """Refuse pictures, named in the message, that the camera of a run does not make."""
    known = run.frames.format
    sizes = [(one.width, one.height, one.tracks) for one in (known, own)]
    differing = [
        what
        for what, same in (
            (f"layout ({known.layout} and {own.layout})", known.layout == own.layout),
            (
                f"size ({known.width}x{known.height} and {own.width}x{own.height})",
                sizes[0] == sizes[1],
            ),
            ("faces", known.faces == own.faces),
            ("calibration", known.fisheyes == own.fisheyes),
        )
        if not same
    ]
    if differing:
        raise GsbaError(
            f"{name} has frames of another {differing[0]} than {run.root}: a run grows by its own "
            "camera in one mode; refine all recordings together (gsba refine A B --out RUN)"
        )


def _best_camera(runs: Sequence[FinishedRun]) -> int:
    """The run that knows most of the camera; of several the first one."""
    lenses = [run.map.lenses for run in runs]
    known = [(bool(one), sum(map(sum, one.parts))) for one in lenses]
    return known.index(max(known))


def _moves(runs: Sequence[FinishedRun]) -> tuple[Sim3, ...]:
    """Similarities of runs from their solutions' worlds to those of their results, with the unit
    of the first run for all that know the distance of the lenses."""
    moves = [run.to_result() for run in runs]
    apart = [move.scale * run.map.lenses.baseline for run, move in zip(runs, moves, strict=True)]
    for n in range(1, len(runs)):
        if apart[0] > 0 and apart[n] > 0:
            ratio = apart[0] / apart[n]
            moves[n] = Sim3.of(ratio, np.eye(4)).after(moves[n])
    return tuple(moves)


def _moved(run: FinishedRun, move: Sim3) -> Solution:
    """The solution of a run in another world."""
    solution = run.map.solution
    landmarks = replace(
        solution.landmarks, points_world=move.points(solution.landmarks.points_world)
    )
    poses = move.poses(solution.world_T_rigs)
    return replace(solution, world_T_rigs=poses, landmarks=landmarks)


def _in_one_noise(run: FinishedRun) -> tuple[Keypoints, np.ndarray]:
    """Keypoints of a run with the noise that its solution found, and which are aligned (N,)."""
    observed, aligned = run.map.observed, run.map.aligned
    scaled = observed.scaled_noise(run.map.solution.noise)
    return scaled, np.zeros(len(observed.faces), bool) if aligned is None else aligned


def _normals(run: FinishedRun) -> np.ndarray:
    normals = run.map.normals_rig
    return np.zeros((len(run.map.observed.faces), 3), np.float32) if normals is None else normals


def _back_to_back(solutions: Sequence[Solution], starts: Sequence[int]) -> Solution:
    """Solutions as one, each part in its own world."""
    begins = np.cumsum([0, *(one.landmarks.tracks.num_points for one in solutions)])
    tracks = [one.landmarks.tracks for one in solutions]
    points = [one.points + begin for one, begin in zip(tracks, begins, strict=False)]
    frames = [one.frames + start for one, start in zip(tracks, starts, strict=False)]
    joined = Tracks(
        np.concatenate(points).astype(np.int32),
        np.concatenate(frames).astype(np.int32),
        np.concatenate([one.keypoints for one in tracks]),
        int(begins[-1]),
    )
    counts = [one.counts for one in solutions]
    landmarks = Landmarks(
        np.concatenate([one.landmarks.points_world for one in solutions]),
        joined,
        Counts(sum(c.received for c in counts), sum(c.kept for c in counts), "tracks"),
    )
    return Solution(np.concatenate([one.world_T_rigs for one in solutions]), landmarks, 1.0, ())


def _parts_of(runs: Sequence[FinishedRun]) -> np.ndarray:
    """Part (F,) int64 of each frame: maps of runs."""
    parts, begin = list[np.ndarray](), 0
    for run in runs:
        own = run.result.components
        own = np.zeros(len(run.frames), np.int64) if own is None else own.astype(np.int64)
        own = np.unique(own, return_inverse=True)[1]
        parts.append(begin + own)
        begin += int(own.max()) + 1
    return np.concatenate(parts)


def _camera(
    runs: Sequence[FinishedRun],
    moves: Sequence[Sim3],
    solution: Solution,
    frames: FrameSet,
    seen_by: int,
) -> CameraEstimate | None:
    """The camera of one run, for the frames of all; None = it has one centre."""
    known = runs[seen_by].map.only
    found = _scaled(known, moves[seen_by].scale)
    if found is None or not known.lenses:
        return found
    lenses = found.lenses
    if lenses.readout_motion is not None:
        lenses = replace(
            lenses,
            readout_motion=_readout_motion(runs, moves, solution, frames, found.readout_s),
        )
    if lenses.axes is not None:
        axes = [
            np.tile(np.eye(3), (len(run.frames), 1, 1))
            if run.map.only.lenses.axes is None
            else run.map.only.lenses.axes
            for run in runs
        ]
        lenses = replace(lenses, axes=np.concatenate(axes))
    return replace(found, lenses=lenses)


def _scaled(found: FoundCamera, scale: float) -> CameraEstimate | None:
    """A camera in another unit: one map unit is `scale` of the new ones; None = it has one centre
    and was not looked for."""
    return found.estimate().scaled(scale) if found.lenses else found.readout


def _in_unit(found: FoundCamera, camera: CameraEstimate | None, scale: float) -> FoundCamera:
    """What is known of a camera in another unit, with its estimate there."""
    radius = found.radius and _rescaled(found.radius, scale)
    centres = _centres(found.centres, camera, scale)
    return FoundCamera(centres, found.axes, radius, found.calibrated, camera)


def _readout_motion(
    runs: Sequence[FinishedRun],
    moves: Sequence[Sim3],
    solution: Solution,
    frames: FrameSet,
    readout_s: float,
) -> np.ndarray:
    """Motion (F, 6) of all frames during the readout: as their run found it, else by velocity."""
    times, motion = own_timestamps(frames), list[np.ndarray]()
    begin = 0
    for run, move in zip(runs, moves, strict=True):
        rows = np.arange(begin, begin + len(run.frames))
        own = run.map.only.lenses.scaled(move.scale).readout_motion
        if own is None:
            own = readout_s * velocities(solution.world_T_rigs[rows], times[rows])
        motion.append(own)
        begin += len(rows)
    return np.concatenate(motion)


def _rescaled(found: StitchRadius, scale: float) -> StitchRadius:
    """An estimated radius in another unit: one map unit is `scale` of the new ones."""
    inverse, sigma = found.inverse_stitch_radius / scale, found.sigma / scale
    lenses = found.lenses.scaled(scale)
    return replace(found, lenses=lenses, inverse_stitch_radius=inverse, sigma=sigma)


def _centres(
    found: LensCentres | None, camera: CameraEstimate | None, scale: float
) -> LensCentres | None:
    """Estimated centres in another unit, with the lenses of a camera."""
    if found is None:
        return None
    lenses = Lenses() if camera is None else camera.lenses
    covariance = found.covariance * scale**2
    return replace(found, lenses=lenses, found=scale * found.found, covariance=covariance)
