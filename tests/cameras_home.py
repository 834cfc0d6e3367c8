"""Two recordings of one rendered walk whose pictures differ: in size, as faces, as raw fisheyes."""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from growing_home import FIRST
from one_gallery import OVAL_FRAMES, OVAL_WIDTH
from pixels import pixel_centres
from tiny_run import exporting

from gsba import Recording, refine_recordings
from gsba.camera.calibration import calibration_json
from gsba.camera.fisheye import unproject
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import around_sphere, erp_from_bearings
from gsba.demo import DemoWalk
from gsba.evaluate.trajectory import evaluate
from gsba.frames.cubemap import cut
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FACES, Fisheye, Trajectory

NUM = OVAL_FRAMES // 2  # frames of a recording
WIDTH, SMALL = OVAL_WIDTH, 384  # of the two cameras
LENS = Fisheye(240, 240, 73.0, (120.0, 120.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
PAIR = LENS, Fisheye(240, 240, 73.0, (120.0, 120.0), (0.0, 0.0, 0.0, 0.0), (0.0, np.pi, 0.0))


class Home(NamedTuple):
    """Two halves of a walk: each half's pictures, trajectory and truth."""

    folder: Path
    pictures: tuple[list[Path], list[Path]]
    trajectories: tuple[Path, Path]
    truth: Trajectory  # of both, one after the other


def make_home(folder: Path, walk: DemoWalk) -> Home:
    """Every other frame of a walk is of the first recording."""
    truth, slam = read_trajectory(walk.truth_path), read_trajectory(walk.slam_path)
    images, files = sorted(walk.frames_dir.glob("*.jpg")), []
    times = 0.5 * np.arange(NUM)
    for n in range(2):
        files.append(folder / f"{n}.tum")
        write_tum(files[-1], Trajectory(times, slam.world_T_rigs[n::2]))
    tree = calibration_json(PAIR, np.array([0.0, 0.0, 0.001]), "map", {})
    (folder / "raw.json").write_text(json.dumps(tree))
    poses = np.concatenate([truth.world_T_rigs[0::2], truth.world_T_rigs[1::2]])
    return Home(
        folder,
        (images[0::2], images[1::2]),
        (files[0], files[1]),
        Trajectory(np.arange(2.0 * NUM), poses),
    )


def _filled(folder: Path, fill: Callable[[Path], None]) -> Path:
    """The folder, filled by the first worker that needs it and seen by others once it is whole."""
    if not folder.exists():
        own = Path(tempfile.mkdtemp(dir=folder.parent))
        fill(own)
        try:
            own.rename(folder)
        except OSError:  # another worker was first
            shutil.rmtree(own)
    return folder


def _times(folder: Path, num: int = NUM) -> None:
    rows = [f"{n:06d},{0.5 * n}" for n in range(num)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))


def panoramas(home: Home, which: int, width: int) -> Recording:
    """A recording as stitched panoramas of a width."""

    def fill(folder: Path) -> None:
        for n, path in enumerate(home.pictures[which]):
            if width == WIDTH:
                shutil.copy(path, folder / f"{n:06d}.jpg")
            else:
                size = (width, width // 2)
                small = cv2.resize(read(path), size, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(folder / f"{n:06d}.jpg"), small)
        _times(folder)

    folder = _filled(home.folder / f"stitched{which}at{width}", fill)
    return Recording(folder, home.trajectories[which])


def beginning(recording: Recording, num: int, folder: Path) -> Recording:
    """The first few frames of panoramas, in a folder of their own."""
    folder.mkdir()
    for n in range(num):
        shutil.copy(Path(recording.frames) / f"{n:06d}.jpg", folder)
    _times(folder, num)
    return Recording(folder, recording.trajectory)


def faces(home: Home) -> Recording:
    """The second recording as cube faces."""

    def fill(folder: Path) -> None:
        for n, path in enumerate(home.pictures[1]):
            for name, image in zip(FACES, cut(read(path), CubeRig(128, np.pi / 2)), strict=True):
                (folder / name).mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / name / f"{n:06d}.png"), image)
        _times(folder)

    return Recording(_filled(home.folder / "faces", fill), home.trajectories[1])


def fisheyes(home: Home, which: int = 1) -> Recording:
    """A recording as two raw fisheyes with one centre, and their calibration."""

    def fill(folder: Path) -> None:
        for name, lens in zip(("front", "back"), PAIR, strict=True):
            (folder / name).mkdir()
            grid = pixel_centres(240, 240)
            places = erp_from_bearings(unproject(lens, grid), WIDTH, WIDTH // 2) - 0.5 + 4
            u, v = np.moveaxis(places, -1, 0).astype(np.float32)
            far = np.hypot(*(np.moveaxis(grid, -1, 0) - 120)) > 73 * np.deg2rad(95)
            for n, path in enumerate(home.pictures[which]):
                shown = cv2.remap(around_sphere(read(path), 4), u, v, cv2.INTER_CUBIC)
                shown[far] = 0
                cv2.imwrite(str(folder / name / f"{n:06d}.png"), shown)
        _times(folder)

    folder = _filled(home.folder / ("raw" if which else "stitched0raw"), fill)
    return Recording(folder, home.trajectories[which], calibration=home.folder / "raw.json")


def read(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path))
    assert pixels is not None
    return pixels


def error_of(run: Path, home: Home) -> float:
    """Error of a run of some of the recordings, all in one map."""
    reconstruction, frames = load_run(run)
    assert reconstruction.num_maps == 1
    first_half = "stitched0", FIRST
    halves = [0 if name.startswith(first_half) else NUM for name in frames.recordings]
    rows = np.concatenate([first + np.arange(NUM) for first in halves])
    times = np.arange(float(len(rows)))
    true = Trajectory(times, home.truth.world_T_rigs[rows])
    return evaluate(Trajectory(times, reconstruction.world_T_rigs), true).ate.rmse


SMALL_EXPORT = exporting("colmap-flat", face_size=64)


def make_beside_faces(home: Home, folder: Path) -> Path:
    """A run of panoramas and, of the second recording, cube faces."""
    out, settings = folder / "cube", exporting("colmap-flat", face_size=64)
    return refine_recordings([panoramas(home, 0, WIDTH), faces(home)], out, settings).out


def make_beside_fisheyes(home: Home, folder: Path) -> Path:
    """A run of panoramas and, of the second recording, raw fisheyes."""
    out, settings = folder / "fisheyes", exporting("colmap", face_size=64)
    return refine_recordings([panoramas(home, 0, WIDTH), fisheyes(home)], out, settings).out


def make_two_sizes(home: Home, folder: Path) -> Path:
    """A run of both recordings as panoramas of two sizes, made at once."""
    out = folder / "sizes"
    refine_recordings([panoramas(home, 0, WIDTH), panoramas(home, 1, SMALL)], out, SMALL_EXPORT)
    return out
