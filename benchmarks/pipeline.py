"""Whole runs of `gsba refine` beside COLMAP's panorama reconstruction of the same frames.

    python benchmarks/pipeline.py --sequences aisle_loop,demo_rectangle --out WORK
    python benchmarks/pipeline.py --pairs 3 --markdown benchmarks/results/short.md

Every row is a separate process, measured from start to exit, and its trajectory is compared with
the truth. Rows are kept in WORK and used again while code, options and frames stay the same, so
that several calls can fill a table: dictionaries of `sequence`, `row`, `trajectory`, and either
`errors` (gsba.evaluate.trajectory), `wall_s`, `cpu_s`, `peak_mb`, `load`, or `reason`. The last
lines state whether the targets hold.

With `--pairs`, rows are of short walks: runs from their coarse trajectory and of the peer's
spherical mode that was faster in a first run of both, in turn, all of them anew.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import (
    code_digest,
    digest,
    kept_row,
    last_line,
    link_frames,
    machine,
    measure,
    outcome,
    refine_command,
    run_row,
    take_frames,
    write_table,
)
from peer import MODES

from gsba.config import ReadSettings
from gsba.disk import write_text
from gsba.evaluate.trajectory import evaluate
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.trajectory.association import associate
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FrameSet, Trajectory

AUC_DEG = ("0.1", "0.25", "0.5", "1", "5")
DEFAULT = "bearing"  # row of the targets and ratios, from the first trajectory
MAX_ATE = {"aisle_loop": 0.003, "gallery_forward": 0.003, "aisle_slam": 0.006}  # rmse, units
MAX_ROTATION = {"aisle_loop": 0.02, "gallery_forward": 0.02}  # median between frames, degrees
MAX_PART = 0.002  # ATE against a peer's result, part of the path, for sequences without a truth
MAX_RESIDUAL = 0.03  # median, degrees, for sequences without a truth
MAX_TIME = 0.25  # of the fastest peer's wall time
DATA = Path(__file__).resolve().parents[2] / "shared/data"
RECORDED = {  # coarse trajectories; every row is run from the first, `DEFAULT` from all
    "aisle_loop": ("slam.tum", "slam_hard.tum"),
    "gallery_forward": ("slam.tum", "slam_hard.tum"),
    "aisle_slam": (
        "frame_trajectory.txt",
        "keyframe_trajectory.txt",
        *(
            f"other_runs/{run}_{kind}.txt"
            for run in ("rect_default_rt", "loop_more", "loop_loop20")
            for kind in ("frame", "keyframe")
        ),
    ),
    "apartment": ("coarse.tum",),
}
WALKS = {  # arguments of `gsba.demo.make_walk`
    "demo_rectangle": "'rectangle', 'locked'",
    "demo_oval": "'oval', 'forward'",
}
SHORT_WALKS = {
    "24 x 1536": "num_frames=24, width=1536",
    "48 x 1024": "num_frames=48, width=1024",
}
FACTOR_SETS = {  # row -> options of `gsba refine`
    "slam": [],  # nothing runs
    "bearing": ["--factors", "bearing"],
    "bearing-unaligned": ["--factors", "bearing", "--set", "patches.rounds=0"],
    "reprojection": ["--factors", "reprojection"],
    "bearing+reprojection": ["--factors", "bearing,reprojection"],
    "no-trajectory": ["--no-trajectory"],
}


@dataclass(frozen=True, slots=True)
class Walk:
    """Frames with coarse trajectories and a reference."""

    name: str
    folder: Path  # images/ and the trajectories
    trajectories: tuple[str, ...]
    reference: Path  # TUM; the truth, or a peer's result if there is none
    mask: Path | None

    @property
    def has_truth(self) -> bool:
        """True if the reference is the truth."""
        return self.reference.stem == "groundtruth"


def find_walk(name: str, data: Path, out: Path) -> Walk:
    """Recorded sequence of the data folder, or a demo walk rendered into `out`.

    Raises:
        GsbaError: the sequence is not on this machine.
    """
    if arguments := (WALKS | SHORT_WALKS).get(name):
        folder = out / name / "walk"
        if not folder.exists():
            _make_walk(folder, arguments)
        return Walk(name, folder, ("slam.tum",), folder / "groundtruth.tum", None)
    folder = data / name
    if not folder.is_dir():
        raise GsbaError(f"{folder} is absent")
    truth, mask = folder / "groundtruth.tum", folder / "mask.png"
    reference = truth if truth.exists() else folder / "peer_colmap.tum"
    trajectories = RECORDED.get(name, ("slam.tum",))
    return Walk(name, folder, trajectories, reference, mask if mask.exists() else None)


def cut_short(walk: Walk, num_frames: int, folder: Path) -> Walk:
    """The first frames of a walk, as links in a folder, with the poses up to the last of them."""
    rows = (walk.folder / "images/timestamps.csv").read_text().splitlines()[1 : num_frames + 1]
    times = np.array([float(row.partition(",")[2]) for row in rows])
    take_frames(walk.folder, np.arange(len(rows)), times, folder / "images")
    for name in (walk.trajectories[0], walk.reference.name):
        poses = read_trajectory(walk.folder / name)
        kept = poses.timestamps <= times[-1] + 1e-6
        write_tum(folder / name, Trajectory(poses.timestamps[kept], poses.world_T_rigs[kept]))
    name, reference = f"{walk.name}, {num_frames} frames", folder / walk.reference.name
    return Walk(name, folder, walk.trajectories[:1], reference, None)


class Bench:
    """Folder and conditions of the rows of one call."""

    def __init__(self, out: Path, timeout_s: float, fresh: bool) -> None:
        self.out, self.timeout_s, self.fresh = out, timeout_s, fresh
        self.code = code_digest()
        self.warm = False

    def rows(self, walk: Walk, sets: Sequence[str], peers: Sequence[str]) -> Iterator[dict]:
        """Yield the rows of one walk, in the order of the table."""
        frames = scan(walk.folder / "images", masks=walk.mask)
        for place, name in enumerate(walk.trajectories):
            for row in sets:
                if row == "slam":
                    yield self.slam(walk, frames, name)
                elif place == 0 or row == DEFAULT:
                    yield self.refine(walk, frames, name, row)
        for mode in peers:
            yield self.peer(walk, frames, mode)

    def slam(self, walk: Walk, frames: FrameSet, trajectory: str) -> dict:
        """Row of the input trajectory, interpolated at the frames' times."""

        def finish() -> dict:
            coarse = associate(frames, read_trajectory(walk.folder / trajectory), ReadSettings())
            return _errors(walk, Trajectory(frames.timestamps, coarse.world_T_rigs))

        return {**_head(walk, "slam", trajectory), **outcome(finish)}

    def refine(self, walk: Walk, frames: FrameSet, trajectory: str, factor_set: str) -> dict:
        """Row of a whole run with one factor set, without a dataset, which the peer does not write
        either."""
        head = _head(walk, factor_set, None if factor_set == "no-trajectory" else trajectory)
        folder = self.out / walk.name / f"{factor_set}-{Path(trajectory).stem}"
        inputs = [walk.folder / trajectory, *([walk.mask] if walk.mask else [])]
        key = {"code": self.code, "input": digest([*_images(frames), *inputs])}
        given = [] if factor_set == "no-trajectory" else [str(walk.folder / trajectory)]
        given += ["--masks", str(walk.mask)] if walk.mask else []
        images, run = walk.folder / "images", folder / "run"
        command = refine_command(images, run, [*given, *FACTOR_SETS[factor_set]])

        def finish() -> dict:
            report = json.loads((folder / "run/report.json").read_text())
            errors = _errors(walk, read_trajectory(folder / "run/trajectory.tum"))
            return {**errors, "residual_deg": report["summary"]["median_residual_deg"]}

        return self._measured(head, folder, key, command, finish)

    def peer(self, walk: Walk, frames: FrameSet, mode: str) -> dict:
        """Row of one of the peer's modes, which take neither trajectory nor mask."""
        head = {**_head(walk, mode, None), "peer": True}
        folder = self.out / walk.name / mode
        key = {"pycolmap": version("pycolmap"), "input": digest(_images(frames))}
        links = link_frames(_images(frames), self.out / walk.name / "images")
        script = str(Path(__file__).with_name("peer.py"))
        command = [sys.executable, script, mode, str(links), str(folder / "model")]

        def finish() -> dict:
            posed = read_trajectory(folder / "model/trajectory.tum")
            times = frames.timestamps[posed.timestamps.astype(int)]
            return _errors(walk, Trajectory(times, posed.world_T_rigs))

        return self._measured(head, folder, key, command, finish)

    def _measured(
        self, head: dict, folder: Path, key: dict, command: list[str], finish: Callable[[], dict]
    ) -> dict:
        """Kept row, or the row of running the command."""
        if not self.fresh and (row := kept_row(folder, key, self.timeout_s)):
            return {**row, **head}
        if "peer" not in head and not self.warm:
            _compile_kernels(self.out / "warm-up")
            self.warm = True
        print(f"{head['sequence']}: running {folder.name}", file=sys.stderr, flush=True)
        row = {**head, "key": key, "machine": machine(), "load": os.getloadavg()[0]}
        row["date"] = datetime.now(UTC).isoformat(timespec="seconds")
        return run_row(command, folder, row, finish, self.timeout_s)


def _head(walk: Walk, row: str, trajectory: str | None) -> dict[str, Any]:
    return {"sequence": walk.name, "row": row, "trajectory": trajectory, "truth": walk.has_truth}


def _errors(walk: Walk, estimate: Trajectory) -> dict[str, Any]:
    """Errors against the reference, and the length of its path."""
    reference = read_trajectory(walk.reference)
    steps = np.diff(reference.world_T_rigs[:, :3, 3], axis=0)
    path = float(np.linalg.norm(steps, axis=1).sum())
    return {"errors": evaluate(estimate, reference).to_json(), "path": path}


def _compile_kernels(out: Path) -> None:
    """Fill numba's cache by a small run, so that measured runs do not compile."""
    folder = out / "walk"
    _make_walk(folder, "'open', num_frames=8, width=512")
    images, trajectory = folder / "images", folder / "slam.tum"
    options = [str(trajectory), *FACTOR_SETS["bearing+reprojection"]]
    _require(refine_command(images, out / "run", options), out)


def _make_walk(folder: Path, arguments: str) -> None:
    program = "from pathlib import Path; from gsba.demo import make_walk; "
    program += f"make_walk(Path({str(folder)!r}), {arguments})"
    _require([sys.executable, "-c", program], folder.parent)


def _require(command: list[str], folder: Path) -> None:
    """Run a preparation that must not fail."""
    log = folder / "preparation.txt"
    if measure(command, log, timeout_s=1200).exit_code != 0:
        raise GsbaError(f"preparation failed, see {log}: {last_line(log)}")


def _images(frames: FrameSet) -> list[Path]:
    return [path for group in frames.paths for path in group]


def _split(text: str) -> list[str]:
    return [part for part in text.split(",") if part]


def to_markdown(rows: Sequence[dict]) -> str:
    """Table of one sequence."""
    header = ["", "posed", "ATE rmse", "rel. rot. °", *(f"AUC@{angle}°" for angle in AUC_DEG)]
    header += ["wall s", "× ours", "CPU s", "peak MB", "load"]
    lines = [header, ["---"] + ["---:"] * (len(header) - 1)]
    lines += [_cells(row, _ours(rows)) for row in rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def verdicts(rows: Sequence[dict]) -> Iterator[tuple[str, bool]]:
    """Yield the targets of one sequence that its rows can check, with True if they hold."""
    ours = _ours(rows)
    if ours is None:
        yield f"`{DEFAULT}` ends with a result", all(row["row"] != DEFAULT for row in rows)
        return
    errors, name = ours["errors"], ours["sequence"]
    ate, rotation = errors["ate"]["rmse"], errors["rpe_rotation_deg"]["median"]
    yield f"{_posed(ours)} frames posed", errors["num_matched"] == errors["num_truth"]
    if limit := MAX_ATE.get(name):
        yield f"ATE {ate:.5f}, at most {limit}", ate <= limit
    if limit := MAX_ROTATION.get(name):
        yield f"relative rotation {rotation:.4f}°, at most {limit}°", rotation <= limit
    if not ours["truth"]:
        part, residual = ate / ours["path"], ours["residual_deg"]
        text = f"{part:.3%} of the path from the peer's result, at most {MAX_PART:.1%}"
        yield text, part <= MAX_PART
        text = f"median residual {residual:.4f}°, at most {MAX_RESIDUAL}°"
        yield text, residual <= MAX_RESIDUAL
    yield from _against_peers(ours, [row for row in rows if row.get("peer")])


def _against_peers(ours: dict, peers: Sequence[dict]) -> Iterator[tuple[str, bool]]:
    """Yield targets: time against the fastest peer with a result, accuracy against the best."""
    peers = [row for row in peers if "errors" in row and row["machine"] == ours["machine"]]
    if not peers:
        return
    fastest = min(peers, key=lambda row: row["wall_s"])
    ratio = ours["wall_s"] / fastest["wall_s"]
    yield f"wall time {ratio:.2f} of {fastest['row']}, at most {MAX_TIME}", ratio <= MAX_TIME
    if not ours["truth"]:
        return
    area, ate = ours["errors"]["auc"]["0.5"], ours["errors"]["ate"]["rmse"]
    best = max(row["errors"]["auc"]["0.5"] for row in peers)
    yield f"AUC@0.5° {100 * area:.1f}, best peer {100 * best:.1f}", area >= best
    whole = [e for row in peers if (e := row["errors"])["num_matched"] == e["num_truth"]]
    if whole:  # the ATE over a part of the frames is not comparable
        best = min(e["ate"]["rmse"] for e in whole)
        yield f"ATE {ate:.5f}, best peer that posed all frames {best:.5f}", ate <= best


def _ours(rows: Sequence[dict]) -> dict | None:
    return next((row for row in rows if row["row"] == DEFAULT and "errors" in row), None)


def _posed(row: dict) -> str:
    return f"{row['errors']['num_matched']}/{row['errors']['num_truth']}"


def _cells(row: dict, ours: dict | None) -> list[str]:
    source = f" ({Path(row['trajectory']).stem})" if row["trajectory"] else ""
    cells = [row["row"] + source]
    if "errors" in row:
        errors = row["errors"]
        cells += [_posed(row), f"{errors['ate']['rmse']:.5f}"]
        relative = errors["rpe_rotation_deg"]["median"]  # None: no two consecutive frames posed
        cells += ["" if relative is None else f"{relative:.4f}"]
        cells += [f"{100 * errors['auc'][angle]:.1f}" for angle in AUC_DEG]
    else:
        cells += [row["reason"].replace("|", "/"), *[""] * (2 + len(AUC_DEG))]
    if "wall_s" not in row:
        return cells + [""] * 5
    ratio = ""
    if ours is not None and ours["machine"] == row["machine"]:
        ratio = f"{row['wall_s'] / ours['wall_s']:.2f}"
    cells += [f"{row['wall_s']:.1f}", ratio, f"{row['cpu_s']:.1f}"]
    return [*cells, f"{row['peak_mb']:.0f}", f"{row['load']:.1f}"]


def short_walks(data: Path, out: Path) -> Iterator[Walk]:
    """Rendered short walks, and the first frames of one with the trajectory of a real SLAM."""
    for name in SHORT_WALKS:
        yield find_walk(name, data, out)
    if (data / "aisle_slam").is_dir():
        yield cut_short(find_walk("aisle_slam", data, out), 48, out / "aisle_slam_48")


def in_pairs(bench: Bench, walk: Walk, num: int) -> str:
    """Line of the table of short walks: one walk, in so many pairs of a run and the peer's.

    Raises:
        GsbaError: one of them has no result.
    """
    frames, start = scan(walk.folder / "images"), walk.trajectories[0]
    bench.refine(walk, frames, start, DEFAULT)  # fills the disk's cache
    modes = [mode for mode in MODES if mode.startswith("spherical")]
    mode = min(modes, key=lambda each: bench.peer(walk, frames, each)["wall_s"])
    ours, peers = list[dict](), list[dict]()
    for _ in range(num):
        ours.append(bench.refine(walk, frames, start, DEFAULT))
        peers.append(bench.peer(walk, frames, mode))
    for row in [*ours, *peers]:
        if "errors" not in row:
            raise GsbaError(f"{walk.name}: {row['row']}: {row['reason']}")
    both = list(zip(ours, peers, strict=True))
    cells = [walk.name]
    cells += [_spread([row["wall_s"] for row in rows], 1) for rows in (ours, peers)]
    cells += [mode.removeprefix("spherical-")]
    cells += [_spread([a[cost] / b[cost] for a, b in both], 2) for cost in ("wall_s", "cpu_s")]
    ates = [[row["errors"]["ate"]["rmse"] for row in rows] for rows in (ours, peers)]
    return f"| {' | '.join([*cells, *(f'{median(each):.5f}' for each in ates)])} |"


def _spread(values: Sequence[float], digits: int) -> str:
    low, middle, high = (f"{v:.{digits}f}" for v in (min(values), median(values), max(values)))
    return f"{middle} ({low} to {high})"


def print_pairs(bench: Bench, data: Path, num: int, markdown: Path | None) -> None:
    """Measure short walks in pairs, and print their table."""
    lines = [
        f"Wall s: median (least to most) of {num} pairs.",
        "",
        "| walk | gsba | COLMAP | mode | gsba / COLMAP | CPU, gsba / COLMAP | ATE gsba | COLMAP |",
        "|---|---:|---:|---|---:|---:|---:|---:|",
    ]
    for walk in short_walks(data, bench.out):
        lines.append(in_pairs(bench, walk, num))
        print(lines[-1], flush=True)
    write_table(lines, markdown)


def main() -> None:
    """Parse, run, print; exit with 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    every = ",".join((*RECORDED, *WALKS))
    parser.add_argument("--data", type=Path, default=DATA, help="recorded sequences")
    others = f"{every}, or another folder of --data with images, slam.tum and groundtruth.tum"
    parser.add_argument("--sequences", type=_split, default=every, help=others)
    parser.add_argument("--peers", type=_split, default=",".join(MODES), help=",".join(MODES))
    parser.add_argument("--no-peers", dest="peers", action="store_const", const=[])
    sets = ",".join(FACTOR_SETS)
    parser.add_argument("--factors", type=_split, default=sets, help=sets)
    parser.add_argument("--out", type=Path, default=Path("build/benchmark"), help="kept rows")
    parser.add_argument("--fresh", action="store_true", help="run these rows again")
    parser.add_argument("--timeout-min", type=float, default=40.0, help="of a row")
    parser.add_argument("--pairs", type=int, metavar="N", help="short walks, in N pairs each")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    if options.pairs:
        bench = Bench(options.out, 60 * options.timeout_min, fresh=True)
        print_pairs(bench, options.data, options.pairs, options.markdown)
        return
    there = ",".join(
        (every, *(name for name in options.sequences if (options.data / name).is_dir()))
    )
    known = ((options.sequences, there), (options.peers, ",".join(MODES)), (options.factors, sets))
    for given, allowed in known:
        if unknown := set(given) - set(allowed.split(",")):
            parser.error(f"{', '.join(sorted(unknown))}: use some of {allowed}")
    bench = Bench(options.out, 60 * options.timeout_min, options.fresh)
    table, text, held = [], [], True
    for name in options.sequences:
        try:
            walk = find_walk(name, options.data, options.out)
            rows = list(bench.rows(walk, options.factors, options.peers))
            section, ok = _section(walk, rows)
        except GsbaError as error:
            rows, section, ok = [], f"## {name}\n\nSkipped: {error}\n", True
        print(section, flush=True)
        table += rows
        text.append(section)
        held &= ok
    if options.json:
        report = json.dumps(table, indent=1) + "\n"
        write_text(options.json, report)
    if options.markdown:
        machines = sorted({row["machine"] for row in table if "machine" in row})
        page = "\n".join(["# gsba refine and its peers\n", f"{'; '.join(machines)}\n", *text])
        write_text(options.markdown, page)
    sys.exit(0 if held else 1)


def _section(walk: Walk, rows: list[dict]) -> tuple[str, bool]:
    """Markdown of one walk; and True if all targets hold."""
    judged = list(verdicts(rows))
    reference = "the exact truth" if walk.has_truth else f"{walk.reference.name}, a peer's result"
    lines = [f"## {walk.name}", "", f"Against {reference}.", "", to_markdown(rows), ""]
    lines += [f"- {'ok' if ok else '**missed**'}: {what}" for what, ok in judged]
    return "\n".join(lines) + "\n", all(ok for _, ok in judged)


if __name__ == "__main__":
    main()
