"""A tiny rendered walk and its run, made once for all tests of the pipeline."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from gsba import refine
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.demo import make_walk
from gsba.demo.walk import Heading, WalkPath, walk_poses
from gsba.evaluate.trajectory import TrajectoryErrors, evaluate
from gsba.pipeline import RunResult
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

NUM_FRAMES, WIDTH = 8, 512
LIGHT = (  # changes of the defaults, as `--set` takes them
    "cubemap.min_face_size=256",
    "cubemap.max_face_size=256",
    "features.max_per_face=400",
    "solver.num_threads=2",
    "weak_frames.mode=off",
    "patches.rounds=2",
)
SETTINGS = load_config(None, LIGHT)


def settings_with(**changes: object) -> RefineSettings:
    """Light settings with changes of some stages."""
    given = SETTINGS.model_dump()
    for stage, values in changes.items():
        given[stage] |= values
    return RefineSettings.model_validate(given)


def exporting(*formats: str, **options: object) -> RefineSettings:
    """Light settings with these exports."""
    return settings_with(export={"formats": formats, **options})


BARE = exporting()  # of runs whose exports no test reads
ONE_ROUND = settings_with(export={"formats": ()}, patches={"rounds": 1})
PLAIN = settings_with(export={"formats": ()}, patches={"rounds": 0})


@dataclass(frozen=True)
class Case:
    """A walk and its run."""

    frames: Path
    slam: Path
    truth: Trajectory
    out: Path
    result: RunResult

    def errors(self, out: Path | None = None) -> TrajectoryErrors:
        return evaluate(read_trajectory((out or self.out) / "trajectory.tum"), self.truth)

    def assert_as_good(self, out: Path, share: float = 1.0) -> None:
        """Another run on these frames is nearer to this one than a share of what this one is off
        the truth.

        Both see the same pictures and differ in which observations pass the gates: by a third of
        this run's error (RMS; .54 at most over 30 runs of several seeds and kinds of CPU code).
        Errors of two runs cannot be compared as closely: they scatter by a tenth, medians of
        seven steps by a sixth.
        """
        own, other = self.errors(), read_trajectory(out / "trajectory.tum")
        apart = evaluate(other, read_trajectory(self.out / "trajectory.tum"))
        assert apart.num_matched == NUM_FRAMES
        assert own.scale * apart.ate.rmse < share * own.ate.rmse
        assert own.scale * apart.rpe_translation.rmse < share * own.rpe_translation.rmse
        assert apart.rpe_rotation_deg.rmse < share * own.rpe_rotation_deg.rmse

    def copy(self, to: Path) -> Path:
        """The finished run in a folder of its own, to go on from."""
        return Path(shutil.copytree(self.out, to))

    def refine(self, out: Path, settings: RefineSettings = SETTINGS, **options) -> RunResult:
        return refine(self.frames, self.slam, out, settings, **options)


def make_case(folder: Path) -> Case:
    """Render the walk into a folder and refine it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsba.demo.walk.walk_poses", _first_third)
        walk = make_walk(folder / "walk", "open", "locked", NUM_FRAMES, WIDTH)
    out = folder / "run"
    result = refine(walk.frames_dir, walk.slam_path, out, SETTINGS)
    return Case(walk.frames_dir, walk.slam_path, read_trajectory(walk.truth_path), out, result)


def _first_third(path: WalkPath, heading: Heading, num_frames: int, seed: int) -> Trajectory:
    """Poses a unit apart, as in a walk three times as long."""
    walk = walk_poses(path, heading, 3 * num_frames, seed)
    return Trajectory(walk.timestamps[:num_frames], walk.world_T_rigs[:num_frames])


def computed_stages(result: RunResult) -> list[str]:
    """Names of the stages that were not taken from an earlier call."""
    return [stage["name"] for stage in result.report["stages"] if not stage["resumed"]]
