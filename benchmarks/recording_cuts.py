"""Recordings for `benchmarks/recordings.py`: parts of a walk, each with its own clock and world."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.demo import degrade
from gsba.evaluate.trajectory import pose_errors
from gsba.geometry import pose
from gsba.similarity import Sim3
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

_SHARE = 1.5  # part of the walk that all recordings cover together: neighbours overlap
_SCALES = (0.4, 0.9, 1.7, 0.6, 1.2, 2.3)  # map units per metre of the trajectories


class Cut(NamedTuple):
    """A recording cut from a walk."""

    folder: Path  # of its frames, with timestamps.csv
    trajectory: Path  # TUM, with drift, in a world and scale of its own
    rows: np.ndarray  # (R,) frames of the walk


def cut(
    walks: Sequence[Path], out: Path, num: int, step: int, exposures: tuple[float, ...] = ()
) -> list[Cut]:
    """Cut a walk into recordings that overlap their neighbours.

    Recordings see the walk at other frames. Each has a clock from 0, and a trajectory that starts
    at the identity of a tilted world.

    Args:
        walks: folder with `images/` and their timestamps.csv, and `groundtruth.tum`; or several of
            the same walk, which recordings are cut from in turn.
        out: folder of the recordings.
        num: number of recordings.
        step: frames of the walk from one frame of a recording to the next, even.
        exposures: factors of the linear light of each recording's pictures; () = as they are.
    """
    num_frames = len((walks[0] / "images/timestamps.csv").read_text().splitlines()) - 1
    length = min(int(_SHARE * num_frames / num), num_frames)
    starts = np.linspace(0, num_frames - length, num).astype(int)
    phases = [(step // 2) * (n % 2) for n in range(num)]
    return [
        cut_rows(
            walks[n % len(walks)],
            np.arange(start + phase, start + length, step),
            out / f"part{n + 1}",
            n,
            exposures[n] if exposures else 1.0,
        )
        for n, (start, phase) in enumerate(zip(starts.tolist(), phases, strict=True))
    ]


def cut_rows(walk: Path, rows: np.ndarray, folder: Path, number: int, exposure: float = 1.0) -> Cut:
    """Cut frames out of a walk as a recording; its trajectory lies beside its folder.

    Args:
        walk: folder, see `cut`.
        rows: (R,) frames of the walk.
        folder: of the recording.
        number: decides world, scale and drift of its trajectory.
        exposure: factor of the linear light of its pictures.
    """
    truth = read_trajectory(walk / "groundtruth.tum")
    times = truth.timestamps[rows] - truth.timestamps[rows[0]]
    take_frames(walk, rows, times, folder, exposure)
    given = Trajectory(times, truth.world_T_rigs[rows])
    coarse = degrade(given, number, scale=_SCALES[number % 6])
    turn = Rotation.from_rotvec([0.3, 1.1 * number, -0.2]).as_matrix()
    moved = Sim3.of(1.0, pose(turn, np.array([3.0 * number, -2.0, 5.0])))
    path = folder.with_name(f"{folder.name}.tum")
    write_tum(path, Trajectory(coarse.timestamps, moved.poses(coarse.world_T_rigs)))
    return Cut(folder, path, rows)


def take_frames(
    walk: Path, rows: np.ndarray, times: np.ndarray, folder: Path, exposure: float = 1.0
) -> None:
    """Put some frames (R,) of a walk, at times (R,) in seconds, and their timestamps.csv into a
    folder."""
    table = (walk / "images/timestamps.csv").read_text().splitlines()[1:]
    names = [Path(row.partition(",")[0]).stem for row in table]
    images = {path.stem: path for path in (walk / "images").iterdir()}
    folder.mkdir(parents=True, exist_ok=True)
    for row in rows.tolist():
        _copy(images[names[row]], folder, exposure)
    lines = [f"{names[row]},{time:.6f}" for row, time in zip(rows.tolist(), times, strict=True)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *lines, ""]))


def position_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Errors (N,) of positions of poses (N, 4, 4) after one alignment to the truth (N, 4, 4), of
    frames that may be of several clocks."""
    times = np.arange(len(true), dtype=np.float64)
    return pose_errors(Trajectory(times, found), Trajectory(times, true)).positions


def _copy(image: Path, folder: Path, exposure: float) -> None:
    """Link an image, or write it with its linear light multiplied."""
    target = folder / image.name
    target.unlink(missing_ok=True)
    if exposure == 1.0:
        target.symlink_to(image.resolve())
        return
    linear = (np.arange(256) / 255) ** 2.2 * exposure
    curve = np.clip(255 * np.minimum(linear, 1.0) ** (1 / 2.2), 0, 255).astype(np.uint8)
    pixels = cv2.imread(str(image))
    assert pixels is not None
    cv2.imwrite(str(target), curve[np.asarray(pixels, np.uint8)], [cv2.IMWRITE_JPEG_QUALITY, 95])
