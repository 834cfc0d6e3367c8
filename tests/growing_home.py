"""Recordings of a rendered oval and runs of them, made once for all tests of runs that grow."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from one_gallery import OVAL_FRAMES
from scipy.spatial.transform import Rotation
from tiny_run import SETTINGS

from gsba import Recording, RefineSettings, refine
from gsba.demo import DemoWalk
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import pose
from gsba.similarity import Sim3
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

NUM = OVAL_FRAMES // 2  # frames of a recording
FORMATS = ("colmap-flat", "tum")
MAX_ERROR = 0.0015  # of a map of both recordings: an eighteenth of a pixel, two units away
SCALES = 1.0, 1.7  # of the trajectories
WORLD = pose(Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 8.0]))


def settings() -> RefineSettings:
    """Light settings with small exports."""
    export = SETTINGS.export.model_copy(update={"formats": FORMATS, "face_size": 64})
    return SETTINGS.model_copy(update={"export": export})


@dataclass(frozen=True)
class GrowingHome:
    """Two recordings of one place, the run of the first one, and a recording of another place."""

    first: Path
    second: Path
    second_trajectory: Path
    elsewhere: Path
    elsewhere_trajectory: Path
    truth: np.ndarray  # (2 NUM, 4, 4), frames of the first recording, then of the second one
    run: Path  # of the first recording, finished

    def recording(self) -> Recording:
        """The second recording."""
        return Recording(self.second, self.second_trajectory)

    def error(self, run: Path) -> float:
        """Error of the exported map of a run of both recordings, or of the first one."""
        reconstruction, frames = load_run(run)
        true = Trajectory(frames.timestamps, self.truth[: len(frames)])
        return evaluate(Trajectory(frames.timestamps, reconstruction.world_T_rigs), true).ate.rmse


def make_growing_home(folder: Path, walk: DemoWalk) -> GrowingHome:
    """Divide the frames of a walk into recordings and refine the first one."""
    slam, truth = read_trajectory(walk.slam_path), read_trajectory(walk.truth_path)
    images = sorted(walk.frames_dir.glob("*.jpg"))
    folders, files = [], []
    for n, name in enumerate(("ground", "upper")):
        poses = Sim3.of(SCALES[n], WORLD if n else np.eye(4)).poses(slam.world_T_rigs[n::2])
        folders.append(_recording(folder / name, images[n::2]))
        files.append(folder / f"{name}.txt")
        write_tum(files[-1], Trajectory(3.5 + 0.5 * np.arange(NUM), poses))
    elsewhere, away = _recording(folder / "elsewhere", images[1::2]), folder / "elsewhere.txt"
    for path in elsewhere.glob("*.jpg"):  # another place: what a mirror shows
        pixels = cv2.imread(str(path))
        assert pixels is not None
        cv2.imwrite(str(path), cv2.flip(pixels, 1))
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored = mirror @ slam.world_T_rigs[1::2] @ mirror
    write_tum(away, Trajectory(3.5 + 0.5 * np.arange(NUM), mirrored))
    refine(folders[0], files[0], folder / "run", settings())
    true = np.concatenate([truth.world_T_rigs[0::2], truth.world_T_rigs[1::2]])
    return GrowingHome(folders[0], folders[1], files[1], elsewhere, away, true, folder / "run")


def _recording(folder: Path, images: list[Path]) -> Path:
    """Folder of frames with a clock that all recordings begin alike."""
    folder.mkdir()
    for number, image in enumerate(images):
        shutil.copy(image, folder / f"{number:06d}.jpg")
    rows = [f"{number:06d},{3.5 + 0.5 * number}" for number in range(len(images))]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))
    return folder
