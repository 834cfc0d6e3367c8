"""A run from frames and a coarse trajectory to refined poses, a cloud and datasets."""

import os
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import gtsam
import numpy as np

from gsba import adjust, cubemap, features, frontend, graph, read, tracks
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.config_file import to_toml
from gsba.export import ExportFormat, export, write_points
from gsba.log import GsbaError
from gsba.matching import SearchableFrames
from gsba.reconstruction import assemble
from gsba.report import build_report, take_notes, write_poses, write_report
from gsba.store import PerFrame, RunStore, atomic_write, fingerprint, load_stage
from gsba.types import (
    CoarsePoses,
    Counts,
    Features,
    FrameSet,
    Keypoints,
    Matches,
    Reconstruction,
    Trajectory,
    VerifiedPairs,
)

ExtraFactors = Callable[[CoarsePoses], Iterable[gtsam.NonlinearFactor]]
T = TypeVar("T")
_GAUGE = (
    "Sim(3)-aligned to the coarse trajectory over its refined SLAM poses: its world and scale; "
    "covariances hold the first pose and the distance to the frame furthest from it"
)


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `refine` leaves in memory; the rest is in the run's folder."""

    out: Path
    frames: FrameSet
    coarse: CoarsePoses  # before
    reconstruction: Reconstruction  # after
    report: dict[str, Any]  # the content of report.json


def refine(
    frames: Path | str,
    trajectory: Path | str,
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    masks: Path | None = None,
    timestamps: Path | None = None,
    fps: float | None = None,
    fresh: bool = False,
    extra_factors: ExtraFactors | None = None,
) -> RunResult:
    """Refine the pose of every frame, and write poses, cloud, report and datasets to `out`.

    A second call with the same `out` takes up finished stages; a changed setting re-runs what
    depends on it.

    Args:
        frames: folder of 2:1 panoramas or of cube faces.
        trajectory: TUM, KITTI or stella_vslam map.msg; T_world_rig.
        out: folder of the run.
        settings: see `gsba.config`.
        masks: one ERP mask for all frames, or a folder of one for each; white = use.
        timestamps: times of the frames (and of a KITTI trajectory's rows).
        fps: frames per second, where no file gives times.
        fresh: forget an earlier run in `out`.
        extra_factors: makes factors of your own on the keys graph.X(frame); they join every
            bundle adjustment (and those are then never resumed).

    Raises:
        GsbaError: an input or setting that cannot be used.
    """
    frames, trajectory, out = Path(frames), Path(trajectory), Path(out)
    settings = settings or RefineSettings()
    frame_set = read.scan(frames, timestamps, fps, masks)
    coarse = read.associate(frame_set, read.read_trajectory(trajectory, timestamps), settings.read)
    with RunStore(out, {"frames": frames, "trajectory": trajectory}, fresh) as store:
        line = _Line(store, frame_set, coarse, settings, extra_factors)
        neighbours, rounds = line.match_neighbours(), settings.rounds
        solved = line.solve("chain", [neighbours.matches], line.start(), rounds.chain)
        adjacent = line.match_along_epipolars(solved)
        near = line.match_known_points("near", solved, loops_closed=False)
        solved = line.solve("dense", [adjacent, near], solved, rounds.dense)
        loops = line.match_loops(solved)
        solved = line.solve("closed", [adjacent, near, loops.matches], solved, rounds.loops)
        for number in range(1, rounds.map_passes + 1):
            wide = line.match_known_points(f"everywhere{number}", solved, loops_closed=True)
            solved = line.solve(f"refined{number}", [adjacent, wide], solved, rounds.refined)
        reconstruction = line.reconstruct(solved)
        return line.write(reconstruction)


def load_run(out: Path) -> tuple[Reconstruction, FrameSet]:
    """Result of a finished run and the frames it was made from.

    Raises:
        GsbaError: `out` is no finished run.
    """
    reconstruction = load_stage(out, "reconstruction", Reconstruction)
    return reconstruction, load_stage(out, "frames", FrameSet)


class _Line:
    """The stages of one run: each stored under what it depends on, and counted for the report."""

    def __init__(
        self,
        store: RunStore,
        frames: FrameSet,
        coarse: CoarsePoses,
        settings: RefineSettings,
        extra_factors: ExtraFactors | None,
    ) -> None:
        self.store, self.frames, self.coarse, self.settings = store, frames, coarse, settings
        self.num_threads = settings.solver.num_threads or os.cpu_count() or 1
        self.rig = cubemap.rig_for(frames, settings.cubemap)
        self.priors = graph.build(coarse.world_T_rigs, settings.priors)
        self.custom = None if extra_factors is None else uuid.uuid4().hex  # resumes nothing
        if extra_factors is not None:
            for factor in extra_factors(coarse):
                self.priors.add(factor)
        self.counts: dict[str, list[Counts]] = {}
        self.solutions: dict[str, Adjustment] = {}
        self.latest = "keypoints"  # the stage that the next one builds on
        paths = [path for group in frames.paths for path in group]
        inputs = [fingerprint(paths), fingerprint(frames.mask_paths), frames.timestamps.tolist()]
        start = [coarse.world_T_rigs.tolist(), settings.read]
        store.stage("frames", [inputs, start], lambda: frames, FrameSet)
        found = self._extract()
        self.keypoints = store.stage(
            "keypoints",
            None,
            lambda: features.gather(found[name] for name in frames.names),
            Keypoints,
            ["frames", "features"],
        )

        def load(frame: int) -> Features:
            return found[frames.names[frame]]

        self.searchable = SearchableFrames(load)
        self.strongest = SearchableFrames(load, settings.pairs.strongest_per_face)

    def _extract(self) -> PerFrame[Features]:
        """Features of every frame: image and mask are read, cut and released one at a time."""
        frames, settings = self.frames, self.settings
        features.keep_freed_memory()
        index = {name: f for f, name in enumerate(frames.names)}

        def compute(name: str) -> Features:
            images, masks = cubemap.load(frames, index[name], self.rig)
            extractor = features.SiftExtractor(settings.features)
            return features.extract(images, masks, self.rig, extractor)

        return self.store.per_frame(
            "features",
            [settings.cubemap, settings.features],
            {
                name: fingerprint([*frames.paths[f], frames.mask_paths[f]])
                for name, f in index.items()
            },
            compute,
            Features,
            num_threads=self.num_threads,
        )

    def start(self) -> Adjustment:
        """The coarse trajectory as a solution without points."""
        return adjust.start(self.coarse.world_T_rigs)

    def match_neighbours(self) -> VerifiedPairs:
        """Verified matches of frames next to one another in time."""
        pairs = self._stage(
            "neighbours",
            self._matching(),
            lambda: frontend.match_neighbours(
                self.searchable,
                self.strongest,
                self.keypoints,
                self.start(),
                self.settings,
                self.num_threads,
            ),
            VerifiedPairs,
        )
        self.counts["neighbours"] = [pairs.counts]
        if pairs.counts.kept == 0:
            reasons = ", ".join(f"{n} {why}" for why, n in pairs.counts.dropped.items() if n)
            raise GsbaError(
                f"no two neighbouring frames match ({pairs.counts.received} pairs: {reasons}): "
                "check that frames and trajectory are of the same recording and on one clock"
            )
        return pairs

    def match_loops(self, solved: Adjustment) -> VerifiedPairs:
        """Verified matches of frames that met the same place again."""
        pairs = self._stage(
            "loops",
            self._matching(),
            lambda: frontend.match_loops(
                self.searchable, self.keypoints, solved, self.settings, self.num_threads
            ),
            VerifiedPairs,
        )
        self.counts["loops"] = [pairs.counts]
        return pairs

    def match_along_epipolars(self, solved: Adjustment) -> Matches:
        """Matches of neighbours in time along their solved epipolar lines."""
        return self._stage(
            "adjacent",
            self._matching(),
            lambda: frontend.match_along_epipolars(
                self.searchable, solved, self.settings, self.num_threads
            ),
            Matches,
        )

    def match_known_points(self, name: str, solved: Adjustment, loops_closed: bool) -> Matches:
        """Matches of solved points in frames further apart."""
        return self._stage(
            name,
            self._matching(),
            lambda: frontend.match_known_points(
                self.searchable,
                self.keypoints,
                solved,
                self.settings,
                self.num_threads,
                loops_closed,
            ),
            Matches,
        )

    def solve(
        self, name: str, matches: Sequence[Matches], start: Adjustment, gates: Sequence[float]
    ) -> Adjustment:
        """Bundle adjustment in rounds over the tracks that matches make."""

        def compute() -> Adjustment:
            chained = tracks.run(matches, np.diff(self.keypoints.starts))
            return adjust.run(
                chained,
                self.keypoints,
                start,
                self.priors,
                self.rig,
                gates,
                self.settings,
                self.num_threads,
            )

        solved = self._stage(name, [self._solving(), gates], compute, Adjustment)
        self.counts[name] = [solved.landmarks.counts]
        self.solutions[name] = solved
        return solved

    def reconstruct(self, solved: Adjustment) -> Reconstruction:
        """Covariances, and everything back in the trajectory's world."""

        def compute() -> Reconstruction:
            covariances = adjust.pose_covariances(
                solved, self.priors, self.keypoints, self.rig, self.settings, self.num_threads
            )
            least = self.settings.rounds.min_observations
            return assemble(solved, covariances, self.keypoints, self.coarse, least)

        return self._stage("reconstruction", self._solving(), compute, Reconstruction)

    def write(self, reconstruction: Reconstruction) -> RunResult:
        """Poses, cloud, report and datasets."""
        store, out, settings = self.store, self.store.root, self.settings
        trajectory = Trajectory(self.frames.timestamps, reconstruction.world_T_rigs)
        read.write_tum(out / "trajectory.tum", trajectory)
        write_poses(out / "poses.csv", self.frames, self.coarse, reconstruction)
        write_points(out / "points.ply", reconstruction)
        atomic_write(out / "config.toml", lambda path: path.write_text(to_toml(settings)))
        for name in settings.export.formats:
            self._export(ExportFormat(name), reconstruction)
        undone = [n for n, s in self.solutions.items() if not all(r.accepted for r in s.rounds)]
        notes = take_notes(self.frames, self.coarse, reconstruction, undone)
        report = build_report(
            settings=settings,
            frames=self.frames,
            coarse=self.coarse,
            reconstruction=reconstruction,
            stages=store.records.values(),
            counts=self.counts,
            solver=[{"stage": name, "rounds": s.rounds} for name, s in self.solutions.items()],
            gauge=_GAUGE,
            notes=notes,
        )
        write_report(out / "report.json", report)
        for name in ("trajectory.tum", "poses.csv", "points.ply", "config.toml", "report.json"):
            store.claim(out / name)
        return RunResult(out, self.frames, self.coarse, reconstruction, report)

    def _export(self, to: ExportFormat, reconstruction: Reconstruction) -> None:
        folder, name = self.store.root / to.value, f"export-{to.value}"
        if not folder.exists():
            self.store.forget(name)

        def compute() -> Counts:
            export(reconstruction, self.frames, folder, to, self.settings.export.face_size)
            return Counts(len(self.frames), len(self.frames), "frames")

        self.store.stage(name, self.settings.export.face_size, compute, Counts, [self.latest])
        self.store.claim(folder)

    def _matching(self) -> list[object]:
        settings = self.settings
        return [settings.pairs, settings.matching, settings.verify, settings.seed]

    def _solving(self) -> list[object]:
        settings = self.settings
        relevant = [settings.triangulate, settings.rounds, settings.priors, settings.solver]
        return [*relevant, settings.factors, self.custom]

    def _stage(self, name: str, key: object, compute: Callable[[], T], returns: type[T]) -> T:
        """A stage that builds on the one before it."""
        result = self.store.stage(name, key, compute, returns, [self.latest])
        self.latest = name
        return result
