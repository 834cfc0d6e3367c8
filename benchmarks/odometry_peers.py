"""Videos without a trajectory: `gsba refine VIDEO` beside COLMAP on the frames that it chose.

    python benchmarks/odometry_peers.py --out WORK WALK... --slam WALK FRAME_TRAJECTORY \
        --markdown benchmarks/results/odometry_peers.md

A WALK is a folder with `images/` (2:1, named by frame number) and `groundtruth.tum`, as dense as a
video: `shared/tools/render_home.py` and `render_walk.py` make such. Each is encoded (H.264), the
video is refined with default options, and COLMAP's spherical pipeline gets RUN/frames, incremental
and global. A SLAM's trajectory of a walk (`--slam`) is compared with our odometry. Rows are kept in
WORK and used again while code, options and input stay the same.
"""

import argparse
import json
import sys
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import code_digest, digest, kept_row, link_frames, refine_command, run_row, write_table
from wrong_maps import MAX_ERROR

from gsba.evaluate.trajectory import pose_errors
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

PEERS = ("spherical-incremental", "spherical-global")
TIMEOUT_S = 3600.0
HEAD = [
    "| walk | frames of the video | chosen | method | posed | ATE 1e-3 "
    "| worst frame, of the extent | CPU s |",
    "|---|---:|---:|---|---:|---:|---:|---:|",
]
ODOMETRY_HEAD = ["| walk | method | posed | ATE, % of the path |", "|---|---|---:|---:|"]


class Walk(NamedTuple):
    """Frames of a video and their exact poses."""

    name: str
    images: list[Path]  # one a frame, named by its number
    truth: Trajectory

    @classmethod
    def read(cls, folder: Path) -> "Walk":
        """Read the walk in a folder.

        Raises:
            GsbaError: the truth has not one pose for each frame.
        """
        images = sorted((folder / "images").glob("*.jpg"))
        truth = read_trajectory(folder / "groundtruth.tum")
        if not images or len(images) != len(truth.timestamps):
            raise GsbaError(f"{folder}: {len(images)} images, {len(truth.timestamps)} true poses")
        times = np.arange(len(images)) * float(np.median(np.diff(truth.timestamps)))
        truth = Trajectory(times, truth.world_T_rigs)  # seconds of the video, from 0
        return cls(folder.name, images, truth)

    def errors(self, estimate: Trajectory) -> dict[str, Any]:
        """Errors of poses at the walk's times, for a row of the table."""
        found = pose_errors(estimate, self.truth)
        at = self.truth.world_T_rigs[:, :3, 3]
        extent = float(np.linalg.norm(np.ptp(at[found.true_rows], axis=0)))
        ate = float(np.sqrt(np.mean(found.positions**2)))
        path = float(np.linalg.norm(np.diff(at, axis=0), axis=1).sum())
        return {
            "posed": len(found.rows),
            "ate": ate,
            "worst": float(found.positions.max()) / extent,
            "of_path": ate / path,
        }


def encode(walk: Walk, video: Path) -> None:
    """Write the frames of a walk as a video at the rate of its truth, unless it exists."""
    if video.is_file():
        return
    import av
    import cv2

    rate = Fraction(1 / float(np.median(np.diff(walk.truth.timestamps)))).limit_denominator(1000)
    partial = video.with_name(f"partial-{video.name}")
    partial.parent.mkdir(parents=True, exist_ok=True)
    options = {"crf": "16", "preset": "veryfast"}
    with av.open(str(partial), "w") as container:
        stream: Any = container.add_stream("libx264", rate=rate, options=options)
        pictures: Any = map(cv2.imread, map(str, walk.images))
        for n, picture in enumerate(pictures):
            if n == 0:
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode())
    partial.rename(video)


def refined(walk: Walk, home: Path, code: str) -> dict[str, Any]:
    """Row of a run on the video; its frames are in `home`/ours/run/frames."""
    video, folder = home / f"{walk.name}.mp4", home / "ours"
    encode(walk, video)
    key = {"code": code, "input": digest(walk.images)}
    if row := kept_row(folder, key, TIMEOUT_S):
        return row
    print(f"{walk.name}: running gsba refine", file=sys.stderr, flush=True)
    run = folder / "run"

    def finish() -> dict[str, Any]:
        of_map = walk.errors(read_trajectory(run / "trajectory.tum"))
        followed = run / "odometry/walk.tum"
        odometry = walk.errors(read_trajectory(followed)) if followed.is_file() else None
        maps = len(json.loads((run / "report.json").read_text())["maps"])
        return {"errors": of_map, "odometry": odometry, "maps": maps}

    row = {"key": key, "method": "gsba refine VIDEO"}
    return run_row(refine_command(video, run, []), folder, row, finish, TIMEOUT_S)


def peer(walk: Walk, home: Path, mode: str) -> dict[str, Any]:
    """Row of a peer on the frames that our run chose."""
    folder, frames = home / mode, sorted((home / "ours/run/frames").glob("*.jpg"))
    key = {"pycolmap": version("pycolmap"), "input": digest(frames)}
    if row := kept_row(folder, key, TIMEOUT_S):
        return row
    print(f"{walk.name}: running {mode}", file=sys.stderr, flush=True)
    links = link_frames(frames, folder / "images")
    numbers = np.array([int(path.stem) for path in frames])

    def finish() -> dict[str, Any]:
        posed = read_trajectory(folder / "model/trajectory.tum")
        times = walk.truth.timestamps[numbers[posed.timestamps.astype(int)]]
        return {"errors": walk.errors(Trajectory(times, posed.world_T_rigs))}

    script = str(Path(__file__).with_name("peer.py"))
    command = [sys.executable, script, mode, str(links), str(folder / "model")]
    row = {"key": key, "method": f"COLMAP {mode}"}
    return run_row(command, folder, row, finish, TIMEOUT_S)


def line(walk: Walk, chosen: int, row: dict[str, Any]) -> str:
    """Line of the table for a run."""
    cost = f"{row['cpu_s']:.0f}"
    cells = [walk.name, str(len(walk.images)), str(chosen), row["method"]]
    if errors := row.get("errors"):
        wrong = " **wrong**" if errors["worst"] > MAX_ERROR else ""
        worst = f"{100 * errors['worst']:.2f} %{wrong}"
        cells += [f"{errors['posed']}", f"{1e3 * errors['ate']:.2f}", worst]
    else:
        cells += ["none", f"{row.get('reason', '')}", ""]
    return f"| {' | '.join([*cells, cost])} |"


def odometry_line(walk: Walk, method: str, errors: dict[str, Any]) -> str:
    """Line of the table of trajectories before refinement."""
    posed = f"{errors['posed']} of {len(walk.images)}"
    return f"| {walk.name} | {method} | {posed} | {100 * errors['of_path']:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="+", type=Path, metavar="WALK")
    parser.add_argument(
        "--slam", nargs=2, action="append", default=[], metavar=("WALK", "TRAJECTORY")
    )
    parser.add_argument("--out", type=Path, default=Path("build/odometry_peers"), help="kept rows")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    code, lines, alone = code_digest(), [], []
    for folder in options.walks:
        walk, home = Walk.read(folder), options.out.resolve() / folder.name
        row = refined(walk, home, code)
        rows = [row]
        if (home / "ours/run/frames").is_dir():
            rows += [peer(walk, home, mode) for mode in PEERS]
        chosen = len(list((home / "ours/run/frames").glob("*.jpg")))
        lines += [line(walk, chosen, one) for one in rows]
        if row.get("odometry"):
            alone.append(odometry_line(walk, "our odometry", row["odometry"]))
        for _, path in (one for one in options.slam if Path(one[0]).name == walk.name):
            errors = walk.errors(read_trajectory(Path(path)))
            alone.append(odometry_line(walk, Path(path).name, errors))
    foot = (
        "ATE: rmse of positions after Sim(3) alignment, metres in flats, of the exported map or "
        f"the largest model. Wrong: a frame off by more than {MAX_ERROR:.0%} of the map's extent. "
        "Our CPU seconds include decoding, odometry and the choice of frames; COLMAP gets frames."
    )
    table = ["# Videos without a trajectory, beside peers", "", *HEAD, *lines, "", foot, ""]
    table += ["Before any refinement:", "", *ODOMETRY_HEAD, *alone]
    print("\n".join(table))
    write_table(table, options.markdown)


if __name__ == "__main__":
    main()
