"""Inputs that are not what they seem: exit code and message of each command, and the error of its
result.

`python benchmarks/doors.py MAKERS DATA --folder SCRATCH --markdown TABLE`: MAKERS holds the scripts
that make the inputs, DATA the sequences that they are made of.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from common import write_table

from gsba.camera.rig import CubeRig
from gsba.evaluate.trajectory import evaluate
from gsba.frames.cubemap import cut
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FACES, Trajectory

MAKERS = ("base", "small", "mk_traj", "mk_gps", "mk_frames", "mk_video", "mk_updown", "mk_black")
TRAJECTORIES = ("lost_identity", "lost_repeat", "nan_rows", "qw_first", "ecef_traj", "utm_traj")
TRAJECTORIES += ("restart_scale", "unix_stella", "keyframes_only", "orb3_euroc", "euroc_csv")
PICTURES = ("gpano_crop", "gpano_poles", "vr180", "top_bottom", "odd_names", "mixed_sizes")
VIDEOS = ("plain", "head_down", "rot180", "rot90", "hlg", "pq")
GPS = ("gps_good", "gps_null5", "gps_null10", "gps_stale6", "gps_stale8", "gpx_null")
GPS += ("gpx_dup_times",)
NOON = 1782907200  # seconds, the first time of the makers' GPX files; frames begin at 0
STARTS = "good to train", "look at", "do not train", "error: "  # of the line that is shown
METRES = 20.0  # in a unit of the true poses, by the makers' GPS positions
TRUTH = Path("small/groundtruth.tum")


@dataclass(frozen=True, slots=True)
class Row:
    """A command on an input."""

    name: str
    command: tuple[object, ...]  # without --out
    truth: Path | None = None


def rows(data: Path) -> Iterator[Row]:
    """The commands of all inputs, in a folder that holds them."""
    small, slam, truth = Path("small/images"), Path("small/slam.tum"), TRUTH
    _date(small)
    yield Row("right", ("refine", small, slam), truth)
    for name in TRAJECTORIES:
        yield Row(name, ("refine", small, f"cases/{name}/traj.txt"), truth)
    for name in GPS:
        (file,) = Path("cases", name).iterdir()
        shift = -NOON if name.startswith("gpx") else 0
        options = "--to", "nerfstudio", "--up", "auto", "--gps", file, f"--gps-offset={shift}"
        yield Row(f"{name}, export", ("export", "runs/right", *options))
        options = "--gps", file, "--set", f"gps.offset_s={shift}"
        yield Row(f"{name}, refine", ("refine", small, slam, *options), truth)
    for name in PICTURES:
        frames = _date(Path("cases", name, "frames"))
        yield Row(name, ("refine", frames, "cases/slam12.tum"), Path("cases/truth12.tum"))
    for name in ("black_bands", "black_shape"):
        walk = data / "gallery_forward"
        command = "refine", _date(Path("cases", name, "frames")), walk / "slam.tum"
        yield Row(name, command, walk / "groundtruth.tum")
    read = read_trajectory(truth)
    of_video = Path("cases/of_video.tum")
    write_tum(of_video, Trajectory(read.timestamps / 2, read.world_T_rigs))
    for name in VIDEOS:
        yield Row(f"{name}, video", ("refine", f"cases/{name}/walk.mp4"), of_video)
    yield Row("rooms with one pair", ("refine", _rooms(data)))
    for walk, every in (("aisle_loop", 4), ("gallery_forward", 3)):
        frames, poses = _every(data / walk, every)
        yield Row(f"{walk}, one frame in {every}, no trajectory", ("refine", frames), poses)
    yield Row("faces of 2048", ("refine", _faces(data)))


def _date(folder: Path, frames: Path | None = None) -> Path:
    """The folder, with times of a frame a second; named as the images in `frames`, by default its
    own."""
    images = (frames or folder).iterdir()
    names = sorted(path.name for path in images if path.suffix in (".jpg", ".png"))
    lines = [f"{name},{n}" for n, name in enumerate(names)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *lines, ""]))
    return folder


def _images(walk: Path) -> list[Path]:
    return sorted(path for path in (walk / "images").iterdir() if path.suffix.lower() == ".jpg")


def _read(path: Path) -> np.ndarray:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


def _saved(pictures: list[np.ndarray], folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for n, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{n:03d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return _date(folder)


def _rooms(data: Path) -> Path:
    """Places that have nothing in common, but for two neighbours."""
    gallery, flat = _images(data / "gallery_forward"), _images(data / "apartment")
    chosen = [*gallery[:2], _images(data / "aisle_loop")[20], flat[0], flat[7], gallery[24]]
    pictures = [cv2.resize(_read(path), (1536, 768)) for path in chosen]
    return _saved(pictures, Path("cases/rooms"))


def _every(walk: Path, every: int) -> tuple[Path, Path]:
    """Frames of a walk, and a file of their true poses."""
    frames = _saved(list(map(_read, _images(walk)[::every])), Path("cases", walk.name))
    poses = read_trajectory(walk / "groundtruth.tum").world_T_rigs[::every]
    file = Path("cases", f"{walk.name}.tum")
    write_tum(file, Trajectory(np.arange(len(poses), dtype=np.float64), poses))
    return frames, file


def _faces(data: Path) -> Path:
    """Nine panoramas of a real flat as large cube faces."""
    folder, rig = Path("cases/faces"), CubeRig(2048, np.pi / 2)
    for path in _images(data / "apartment")[:9]:
        for name, face in zip(FACES, cut(_read(path), rig), strict=True):
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{path.stem}.jpg"), face)
    return _date(folder, folder / FACES[0])


def run(row: Row) -> str:
    """Run a command, and a line of the table on it."""
    out = Path("runs", row.name.replace(", ", "-").replace(" ", "-"))
    command = [sys.executable, "-c", "from gsba.cli import main; main()", *map(str, row.command)]
    shutil.rmtree(out, ignore_errors=True)
    command += ["--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
    words = [line for line in said if line.startswith(STARTS)] or said[-1:]
    return f"| {row.name} | {done.returncode} | {_value(row, out)} | {words[0][:300]} |"


def _value(row: Row, out: Path) -> str:
    """Scale of an exported world, or error of the refined positions, where the truth is known."""
    if row.command[0] == "export":
        file = out / "transform.json"
        scale = json.loads(file.read_text())["scale"] if file.exists() else None
        run = read_trajectory(Path("runs/right/trajectory.tum"))
        true = METRES * evaluate(run, read_trajectory(TRUTH)).scale
        return f"scale {scale:.1f}, true {true:.1f}" if scale else ""
    if row.truth is None or not (out / "trajectory.tum").exists():
        return ""
    truth, found = read_trajectory(row.truth), read_trajectory(out / "trajectory.tum")
    extent = np.linalg.norm(np.ptp(truth.world_T_rigs[:, :3, 3], axis=0))
    ate = evaluate(found, truth).ate.rmse / extent
    return f"{len(found.timestamps)} frames, ATE {100 * ate:.2g} % of the extent"


def main() -> None:
    """Make the inputs, run the commands, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("makers", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--markdown", type=Path)
    given = parser.parse_args()
    makers, data = given.makers.resolve(), given.data.resolve()
    table = given.markdown and given.markdown.resolve()
    given.folder.mkdir(parents=True, exist_ok=True)
    os.chdir(given.folder)
    Path("cases").mkdir(exist_ok=True)
    where = {**os.environ, "DATA": str(data), "PYTHONPATH": str(makers)}
    for name in MAKERS:
        subprocess.run([sys.executable, makers / f"{name}.py"], env=where, check=True)
    lines = ["| input | exit | value | says |", "|---|---:|---|---|"]
    for row in rows(data):
        lines.append(run(row))
        print(lines[-1], flush=True)
    write_table(lines, table)


if __name__ == "__main__":
    main()
