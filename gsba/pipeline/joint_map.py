"""Maps of finished runs laid back to back in the worlds of their results; nothing ties them yet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from gsba.features.detection import on_faces
from gsba.frames.cubemap import rig_for
from gsba.frames.recordings import combine
from gsba.log import GsbaError
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_cameras import JointCameras
from gsba.pipeline.map import Map
from gsba.similarity import Sim3
from gsba.types import Counts, FrameSet, Keypoints, Landmarks, Solution, Tracks


@dataclass(frozen=True, slots=True)
class JointMaps:
    """Frames and maps of several runs, one run after the other."""

    runs: tuple[FinishedRun, ...]
    moves: tuple[Sim3, ...]  # of each run, from its solution's world to the one that it has here
    starts: tuple[int, ...]  # first frame of each run, and the number of all
    frames: FrameSet
    map: Map  # each part in a world of its own
    parts: np.ndarray  # (F,) int64, part of each frame: maps of a run are parts of their own
    cameras: JointCameras

    @classmethod
    def of(cls, runs: Sequence[FinishedRun]) -> "JointMaps":
        """Lay the maps of runs back to back; GsbaError for runs of different features or faces,
        with recordings of one name, or with one recording twice."""
        for run, name in product(runs[1:], ("features", "cubemap")):
            if getattr(run.settings, name) != getattr(runs[0].settings, name):
                raise GsbaError(
                    f"{run.root} has other settings of [{name}] than {runs[0].root}: refine it "
                    f"with --config {runs[0].root / 'config.toml'}"
                )
        cameras = JointCameras.of(runs)
        frames = _frames_of(runs, cameras)
        starts = (0, *np.cumsum([len(run.frames) for run in runs]).tolist())
        # Similarities from solutions' to results' worlds, in the first run's unit if known
        moves = [run.to_result() for run in runs]
        for n in range(1, len(runs)):
            for pair in cameras.shared(0, n):
                apart = [
                    moves[m].scale * runs[m].map.cameras[c].lenses.baseline
                    for m, c in zip((0, n), pair, strict=True)
                ]
                if min(apart) > 0:
                    moves[n] = Sim3.of(apart[0] / apart[1], np.eye(4)).after(moves[n])
                    break
        moves = tuple(moves)
        solutions = [_moved(run, move) for run, move in zip(runs, moves, strict=True)]
        observed = [run.map.observed.scaled_noise(run.map.solution.noise) for run in runs]
        rig = rig_for(frames.formats[0], runs[0].settings.cubemap)
        keypoints = on_faces(joined_keypoints(observed), rig)
        solution = _back_to_back(solutions, starts)
        parts, num_parts = list[np.ndarray](), 0
        for run in runs:
            own = run.result.components
            own = np.zeros(len(run.frames), int) if own is None else own
            own = np.unique(own, return_inverse=True)[1]
            parts.append(num_parts + own)
            num_parts += int(own.max()) + 1
        map_ = Map(
            solution,
            keypoints,
            np.concatenate([run.map.frame_weights for run in runs]),
            np.concatenate([run.map.confirmed for run in runs]),
            np.concatenate([run.map.normals for run in runs]),
            None if len(cameras.formats) > 1 else runs[cameras.seen_by[0]].map.stitching,
            cameras.found(runs, moves, solution, frames),
            frames.camera_of_frame,
        )
        return cls(tuple(runs), moves, starts, frames, map_, np.concatenate(parts), cameras)

    def rows(self, number: int) -> np.ndarray:
        """Frames (F',) int64 of a run."""
        return np.arange(self.starts[number], self.starts[number + 1])

    def main_rows(self, number: int) -> np.ndarray:
        """Frames (F',) int64 of the largest map of a run."""
        return self.starts[number] + self.runs[number].result.largest_map()

    def unit_frames(self) -> list[int]:
        """For each camera (C,), a frame of the map in whose unit it is."""
        return [int(self.main_rows(number)[0]) for number in self.cameras.seen_by]


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


def _frames_of(runs: Sequence[FinishedRun], cameras: JointCameras) -> FrameSet:
    recordings: dict[str, FrameSet] = {}
    for run in runs:
        for name, own in run.recordings().items():
            if name in recordings:
                raise GsbaError(
                    f"{run.root} has a recording named '{name}', and so has a run before it: "
                    "refine one of them under another name (--recording PATH,name=NAME)"
                )
            recordings[name] = own
    fetched = [flag for run in runs for flag in run.frames.fetched or (False,) * len(run.frames)]
    return replace(
        combine(recordings),
        formats=cameras.formats,
        camera_of_frame=cameras.of_frames(runs),
        fetched=tuple(fetched) if any(fetched) else (),
    )


def _moved(run: FinishedRun, move: Sim3) -> Solution:
    solution = run.map.solution
    landmarks = replace(
        solution.landmarks, points_world=move.points(solution.landmarks.points_world)
    )
    poses = move.poses(solution.world_T_rigs)
    return replace(solution, world_T_rigs=poses, landmarks=landmarks)


def _back_to_back(solutions: Sequence[Solution], starts: Sequence[int]) -> Solution:
    tracks = [one.landmarks.tracks for one in solutions]
    pairs = zip(tracks, starts, strict=False)
    moved = [replace(one, frames=one.frames + np.int32(start)) for one, start in pairs]
    counts = [one.counts for one in solutions]
    landmarks = Landmarks(
        np.concatenate([one.landmarks.points_world for one in solutions]),
        Tracks.joined(moved),
        Counts(sum(c.received for c in counts), sum(c.kept for c in counts), "tracks"),
    )
    return Solution(np.concatenate([one.world_T_rigs for one in solutions]), landmarks, 1.0, ())
