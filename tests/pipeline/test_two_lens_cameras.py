"""Two cameras of two lenses in one run: distances of both are found, at once or one by one."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from accuracy import assert_as_accurate
from tiny_run import SETTINGS

from gsba import Recording, RefineSettings, add_recordings, load_run, refine, refine_recordings
from gsba.camera.sphere import erp_directions
from gsba.demo import make_walk
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.evaluate import TrajectoryErrors, evaluate
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

pytestmark = pytest.mark.slow

NUM = 16  # frames of a recording
BASELINES, WIDTHS = (0.05, 0.08), (768, 640)  # of the two cameras
TWO_LENSES = RefineSettings.model_validate(
    SETTINGS.model_dump()
    | {"patches": RefineSettings().patches.model_dump(), "export": {"formats": ()}}
)


@dataclass(frozen=True)
class Films:
    """Two recordings of one walk, every other frame by either camera."""

    recordings: tuple[Recording, Recording]
    truth: np.ndarray  # (2 NUM, 4, 4), frames of the first recording, then of the second one

    def errors(self, run: Path) -> TrajectoryErrors:
        """Errors of all frames, which must be in one map."""
        reconstruction, frames = load_run(run)
        assert reconstruction.num_maps == 1 and len(frames) == 2 * NUM
        times = np.arange(2.0 * NUM)
        true = Trajectory(times, self.truth)
        return evaluate(Trajectory(times, reconstruction.world_T_rigs), true)


def _seen_by_turns(scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """A panorama stitched at infinity by the camera that takes the frame of this pose."""
    positions = walk_poses("rectangle", "forward", 2 * NUM, 0).world_T_rigs[:, :3, 3]
    frame = int(np.linalg.norm(positions - world_T_rig[:3, 3], axis=1).argmin())
    halves = []
    for sign in (1, -1):
        lens = world_T_rig.copy()
        lens[:3, 3] += sign * 0.5 * BASELINES[frame % 2] * world_T_rig[:3, 2]
        halves.append(render_erp(scene, lens, width, height))
    ahead = erp_directions(width)[..., 2] > 0
    return np.where(ahead[..., None], *halves)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Films:
    folder = tmp_path_factory.mktemp("films")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsba.demo.render.render_erp", _seen_by_turns)
        walk = make_walk(folder / "walk", "rectangle", "forward", 2 * NUM, WIDTHS[0])
    truth, slam = read_trajectory(walk.truth_path), read_trajectory(walk.slam_path)
    images, recordings = sorted(walk.frames_dir.glob("*.jpg")), []
    for n, (name, width) in enumerate(zip(("narrow", "wide"), WIDTHS, strict=True)):
        (folder / name).mkdir()
        for number, path in enumerate(images[n::2]):
            pixels = cv2.imread(str(path))
            assert pixels is not None
            size = (width, width // 2)
            small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / name / f"{number:06d}.png"), small)
        times = 0.5 * np.arange(NUM)
        rows = [f"{number:06d},{time}" for number, time in enumerate(times)]
        (folder / name / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))
        trajectory = folder / f"{name}.tum"
        write_tum(trajectory, Trajectory(times, slam.world_T_rigs[n::2]))
        recordings.append(Recording(folder / name, trajectory))
    poses = np.concatenate([truth.world_T_rigs[0::2], truth.world_T_rigs[1::2]])
    return Films((recordings[0], recordings[1]), poses)


def _check_baselines(run: Path, errors: TrajectoryErrors) -> None:
    cameras = json.loads((run / "report.json").read_text())["cameras"]
    assert [one["width"] for one in cameras] == list(WIDTHS)
    for one, baseline in zip(cameras, BASELINES, strict=True):
        assert one["lenses"]["taken"]
        assert errors.scale * one["lenses"]["baseline"] == pytest.approx(baseline, rel=0.03)


def test_two_cameras_of_two_lenses_are_found_at_once_and_one_after_the_other(
    films: Films, tmp_path: Path
) -> None:
    at_once = tmp_path / "at_once"
    refine_recordings(films.recordings, at_once, TWO_LENSES)
    errors = films.errors(at_once)
    _check_baselines(at_once, errors)
    # Without lenses the same frames are far worse.
    central = TWO_LENSES.model_dump() | {"camera": {"model": "central"}}
    settings = RefineSettings.model_validate(central)
    refine_recordings(films.recordings, tmp_path / "central", settings)
    assert errors.ate.rmse < 0.2 * films.errors(tmp_path / "central").ate.rmse
    first = films.recordings[0]
    refine(first.frames, first.trajectory, tmp_path / "grown", TWO_LENSES)
    add_recordings(tmp_path / "grown", films.recordings[1:])
    grown = films.errors(tmp_path / "grown")
    _check_baselines(tmp_path / "grown", grown)
    assert_as_accurate(tmp_path / "grown", grown.ate.rmse / grown.scale, at_once, 1.25)
