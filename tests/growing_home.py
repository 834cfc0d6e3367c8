"""Two recordings of a rendered oval and a run of the first one, made once for all tests."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from one_gallery import OVAL_FRAMES
from scipy.spatial.transform import Rotation
from tiny_run import exporting

from gsba import Recording, refine
from gsba.demo import DemoWalk
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import pose
from gsba.similarity import Sim3
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

NUM = OVAL_FRAMES // 2  # frames of a recording
MAX_ERROR = 0.0015  # of a map of both recordings: an eighteenth of a pixel, two units away
SCALES = 1.0, 1.7  # of the trajectories
WORLD = pose(Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 8.0]))
CLOCKS = 100.0, 3.5  # seconds at the first frames
FIRST = "ground"  # recording
SMALL_EXPORTS = exporting("colmap-flat", "tum", face_size=64)


@dataclass(frozen=True)
class GrowingHome:
    """Two recordings of one place, the run of the first one, and a recording of another place."""

    folders: tuple[Path, Path]
    trajectories: tuple[Path, Path]
    truths: tuple[Trajectory, Trajectory]  # on the recordings' clocks
    elsewhere: Path
    elsewhere_trajectory: Path
    run: Path  # of the first recording, finished

    def recording(self) -> Recording:
        """The second recording."""
        return Recording(self.folders[1], self.trajectories[1])

    def error(self, run: Path) -> float:
        """Error of the exported map of a run of both recordings, or of the first one."""
        reconstruction, frames = load_run(run)
        truth = np.concatenate([one.world_T_rigs for one in self.truths])
        true = Trajectory(frames.timestamps, truth[: len(frames)])
        return evaluate(Trajectory(frames.timestamps, reconstruction.world_T_rigs), true).ate.rmse


def make_growing_home(folder: Path, walk: DemoWalk) -> GrowingHome:
    """Every other frame of a walk is of the first recording, which is refined."""
    slam, truth = read_trajectory(walk.slam_path), read_trajectory(walk.truth_path)
    images = sorted(walk.frames_dir.glob("*.jpg"))
    folders, files, truths = [], [], []
    for n, name in enumerate((FIRST, "upper")):
        times = CLOCKS[n] + 0.5 * np.arange(NUM)
        poses = Sim3.of(SCALES[n], WORLD if n else np.eye(4)).poses(slam.world_T_rigs[n::2])
        folders.append(_recording(folder / name, images[n::2], times))
        files.append(folder / f"{name}.txt")
        write_tum(files[-1], Trajectory(times, poses))
        truths.append(Trajectory(times, truth.world_T_rigs[n::2]))
    num = NUM // 2  # frames of another place
    elsewhere = _recording(folder / "elsewhere", images[1 : 2 * num : 2], times[:num])
    for path in elsewhere.glob("*.jpg"):  # another place: what a mirror shows
        pixels = cv2.imread(str(path))
        assert pixels is not None
        cv2.imwrite(str(path), cv2.flip(pixels, 1))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    away = folder / "elsewhere.txt"
    write_tum(away, Trajectory(times[:num], mirror @ slam.world_T_rigs[1 : 2 * num : 2] @ mirror))
    refine(folders[0], files[0], folder / "run", SMALL_EXPORTS)
    recorded = (folders[0], folders[1]), (files[0], files[1]), (truths[0], truths[1])
    return GrowingHome(*recorded, elsewhere, away, folder / "run")


def _recording(folder: Path, images: list[Path], times: np.ndarray) -> Path:
    """Folder of frames with their times."""
    folder.mkdir()
    for number, image in enumerate(images):
        shutil.copy(image, folder / f"{number:06d}.jpg")
    rows = [f"{number:06d},{time}" for number, time in enumerate(times)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))
    return folder
