"""Several recordings of a flat refined in one run, beside each alone and beside COLMAP.

    python benchmarks/recordings.py --out WORK --markdown benchmarks/results/recordings.md \
        --walk FLAT --other FLAT

A FLAT is a folder with `images/` and their timestamps.csv, `groundtruth.tum` and, where somebody
carries the camera, `mask.png`. Each walk is cut into recordings with clocks, worlds and scales of
their own (`recording_cuts.py`), which are refined from trajectories with drift, from none, and from
every other one's; and two recordings once more with exposures 30 % apart. Each recording is refined
alone, too, and COLMAP gets all pictures. `--changed FLAT AGAIN` cuts every other recording from
AGAIN, the same walk with furniture moved or in another light. A part of each walk with a part of
each `--other` flat must stay apart. Every run is a process of its own; rows are kept in WORK and
used again while code and input stay the same. The exit code is 1 if a map joins two flats, frames
are left out of the map, or its error exceeds 1.5 times that of the best recording alone.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from common import code_digest, digest, kept_row, run_row, write_table
from recording_cuts import Cut, cut, position_errors

from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory

MIN_ALIGNED = 3  # frames of a recording whose own error is computed
MAX_RATIO = 1.5  # of the error of all recordings to that of the best one alone
TIMEOUT_S = 3600.0
STARTS = ("trajectories", "none", "half")
HEAD = [
    "| flat | recordings | start | in the exported map | other maps | ATE mm | best alone mm | "
    "each, of alone | CPU s | verdict |",
    "|---|---|---|---:|---|---:|---:|---:|---:|---|",
]
_GSBA = [sys.executable, "-c", "from gsba.cli import main; main()", "refine"]


class Part(NamedTuple):
    """A recording of a run."""

    walk: Path
    cut: Cut
    name: str  # of the recording
    start: bool  # whether it is given its trajectory

    @property
    def mask(self) -> Path | None:
        """Mask of who carries the camera, if somebody does."""
        path = self.walk / "mask.png"
        return path if path.exists() else None


def command(parts: Sequence[Part], run: Path) -> list[str]:
    """Command that refines recordings, one alone as the only one."""
    options = ["--out", str(run), "--fresh", "--allow-partial", "--set", "export.formats=[]"]
    if len(parts) == 1:
        (one,) = parts
        files = [str(one.cut.trajectory)] if one.start else []
        mask = ["--masks", str(one.mask)] if one.mask else []
        return [*_GSBA, str(one.cut.folder), *files, *mask, *options]
    for one in parts:
        text = f"{one.cut.folder},name={one.name}"
        text += f",masks={one.mask}" if one.mask else ""
        text += f",trajectory={one.cut.trajectory}" if one.start else ""
        options += ["--recording", text]
    return [*_GSBA, *options]


def check_maps(run: Path, parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Frames, flats and error in millimetres of each map of a run, the exported one first; and of
    each recording's frames in it, aligned by themselves."""
    report = json.loads((run / "report.json").read_text())
    walks = {one.name: one.walk for one in parts}
    checked = []
    for entry in report["maps"]:
        reconstruction, frames = load_run(run, entry["map"])
        names = [name.rpartition("/") for name in frames.names]
        owners = [walks.get(owner, parts[0].walk) for owner, _, _ in names]
        rows = np.array([int(name) for _, _, name in names])
        flats = sorted({walk.name for walk in owners})
        ate, each = np.nan, {}
        if len(flats) == 1:
            ate = _ate(reconstruction.world_T_rigs, rows, owners[0])
            for owner in walks:
                own = np.array([name[0] == owner for name in names])
                if np.count_nonzero(own) >= MIN_ALIGNED:
                    each[owner] = _ate(reconstruction.world_T_rigs[own], rows[own], owners[0])
        checked.append({"frames": len(frames), "flats": flats, "ate_mm": ate, "each_mm": each})
    return checked


def _ate(world_T_rigs: np.ndarray, rows: np.ndarray, walk: Path) -> float:
    """Error in millimetres (1e-3 units) of poses of frames `rows` of a walk, some of them twice."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs[rows]
    return 1e3 * float(np.sqrt(np.mean(position_errors(world_T_rigs, truth) ** 2)))


class Bench(NamedTuple):
    """Folder and code of the rows of one call."""

    out: Path
    code: str

    def row(self, parts: Sequence[Part], label: str, start: str) -> dict[str, Any]:
        """Row of one run of gsba."""
        folder = self.out / label / start
        key = {"code": self.code, "input": digest(_files(parts))}
        if row := kept_row(folder, key, TIMEOUT_S):
            return row
        print(f"running {folder}", file=sys.stderr, flush=True)

        def finish() -> dict[str, Any]:
            return {"errors": check_maps(folder / "run", parts)}

        frames = sum(len(one.cut.rows) for one in parts)
        row = {"key": key, "label": label, "start": start, "frames": frames}
        done = run_row(command(parts, folder / "run"), folder, row, finish, TIMEOUT_S)
        shutil.rmtree(folder / "run" / "stages", ignore_errors=True)
        return done

    def peer(self, parts: Sequence[Part], label: str) -> dict[str, Any]:
        """Row of COLMAP's panorama reconstruction of the same pictures."""
        folder = self.out / label / "peer"
        images = folder / "frames"
        shutil.rmtree(images, ignore_errors=True)
        images.mkdir(parents=True)
        rows = []
        for one in parts:
            for row, path in zip(one.cut.rows, sorted(one.cut.folder.glob("*.jpg")), strict=True):
                (images / f"{one.name}_{path.name}").symlink_to(path.resolve())
                rows.append(int(row))
        key = {
            "code": digest([Path(__file__).with_name("peer.py")]),
            "input": digest(_files(parts)),
        }
        if row := kept_row(folder, key, TIMEOUT_S):
            return row
        print(f"running {folder}", file=sys.stderr, flush=True)

        def finish() -> dict[str, Any]:
            found = read_trajectory(folder / "model/trajectory.tum")
            posed = np.array(rows)[found.timestamps.astype(int)]
            ate = _ate(found.world_T_rigs, posed, parts[0].walk)
            flats = [parts[0].walk.name]
            return {"errors": [{"frames": len(posed), "flats": flats, "ate_mm": ate}]}

        peer = [sys.executable, str(Path(__file__).with_name("peer.py")), "spherical-incremental"]
        words = [*peer, str(images), str(folder / "model")]
        row = {"key": key, "label": label, "start": "COLMAP", "frames": len(rows)}
        return run_row(words, folder, row, finish, TIMEOUT_S)


def _files(parts: Sequence[Part]) -> list[Path]:
    """Files that a run reads."""
    files = []
    for one in parts:
        files += [*sorted(one.cut.folder.iterdir())] + ([one.mask] if one.mask else [])
        files += [one.cut.trajectory] if one.start else []
    return files


def verdict(row: dict[str, Any], best_mm: float | None, apart: bool) -> str:
    """Verdict on a row's map; "" for the peer.

    Args:
        row: result of `Bench.row` or `Bench.peer`.
        best_mm: error of the best recording alone, millimetres; None: not known.
        apart: whether the recordings are of two flats.
    """
    if row["start"] == "COLMAP":
        return ""
    if not row.get("errors"):
        return f"**refused: {row.get('reason', 'no map')}**"
    if any(len(one["flats"]) > 1 for one in row["errors"]):
        return "**false join**"
    if apart:
        return "apart"
    first = row["errors"][0]
    if best_mm is not None and not first["ate_mm"] <= MAX_RATIO * best_mm:
        return "**worse**"
    return "right" if first["frames"] == row["frames"] else "**frames left out**"


def line(
    flat: str, what: str, row: dict[str, Any], alone_mm: Mapping[str, float], found: str
) -> str:
    """Line of the table; `alone_mm`: error of each recording alone, by its name."""
    first, *others = row.get("errors") or [{"frames": 0, "ate_mm": np.nan}]
    cells = [flat, what, row["start"], f"{first['frames']} of {row['frames']}"]
    cells.append(", ".join(f"{one['frames']} ({one['ate_mm']:.1f})" for one in others))
    cells += [f"{first['ate_mm']:.2f}", f"{min(alone_mm.values()):.2f}" if alone_mm else ""]
    own_mm = first.get("each_mm", {})
    ratios = [own_mm[name] / alone_mm[name] for name in own_mm.keys() & alone_mm]
    cells.append(f"{min(ratios):.2f} to {max(ratios):.2f}" if ratios else "")
    cells += [f"{row['cpu_s']:.0f}", found]
    return f"| {' | '.join(cells)} |"


class Variant(NamedTuple):
    """Recordings that a walk is cut into."""

    num: int
    step: int  # frames of the walk from one frame of a recording to the next
    exposures: tuple[float, ...] = ()
    changed: Path | None = None  # the same walk with things changed, for every other recording


def of_walk(bench: Bench, walk: Path, variant: Variant, peer: bool) -> list:
    """Lines and verdicts of one walk, cut into recordings."""
    num, step, exposures, changed = variant
    walks = (walk, changed) if changed else (walk,)
    label = f"{'+'.join(one.name for one in walks)}-{num}"
    plain = cut(walks, bench.out / label / "cuts", num, step)
    alone = [
        bench.row([Part(walk, one, f"part{n}", True)], f"{label}-part{n}", "alone")
        for n, one in enumerate(plain)
    ]
    label += "-exposed" if exposures else ""
    cuts = cut(walks, bench.out / label / "cuts", num, step, exposures) if exposures else plain

    def parts(start: str) -> list[Part]:
        given = [start == "trajectories" or (start == "half" and n % 2 == 0) for n in range(num)]
        return [Part(walk, one, f"part{n}", given[n]) for n, one in enumerate(cuts)]

    known = {
        f"part{n}": row["errors"][0]["ate_mm"] for n, row in enumerate(alone) if row.get("errors")
    }
    best = min(known.values(), default=None)
    what = f"{num}, exposures {', '.join(map(str, exposures))}" if exposures else str(num)
    what += f", every other one of {changed.name}" if changed else ""
    rows = [bench.row(parts(start), label, start) for start in STARTS[: 2 if exposures else 3]]
    rows += [bench.peer(parts("trajectories"), label)] if peer else []
    lines = []
    for row in rows:
        found = verdict(row, best, apart=False)
        lines.append((line(walk.name, what, row, known, found), found))
        print(lines[-1][0], flush=True)
    return lines


def of_pair(bench: Bench, walk: Path, other: Path, step: int) -> list:
    """Lines and verdicts of recordings of two flats in one run."""
    label = f"{walk.name}+{other.name}"
    cuts = [cut((one,), bench.out / label / one.name, 2, step)[0] for one in (walk, other)]
    lines = []
    for start in STARTS[:2]:
        given = start == "trajectories"
        pairs = zip((walk, other), cuts, strict=True)
        parts = [Part(one, own, f"part{n}", given) for n, (one, own) in enumerate(pairs)]
        row = bench.row(parts, label, start)
        found = verdict(row, None, apart=True)
        lines.append((line(label, "1 of each flat", row, {}, found), found))
        print(lines[-1][0], flush=True)
    return lines


def main() -> None:
    """Parse, run, print; exit with 1 if a bar is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--walk", action="append", type=Path, default=[], metavar="FLAT")
    parser.add_argument("--other", action="append", type=Path, default=[], metavar="FLAT")
    parser.add_argument(
        "--changed", action="append", type=Path, nargs=2, default=[], metavar=("FLAT", "AGAIN")
    )
    parser.add_argument("--num", action="append", type=int, help="recordings; default: 2, 3, 6")
    parser.add_argument("--step", type=int, default=4, help="walk's frames per recording's frame")
    parser.add_argument("--no-peer", action="store_true", help="leave COLMAP out")
    parser.add_argument("--out", type=Path, default=Path("build/recordings"), help="kept rows")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    bench, peer = Bench(options.out.resolve(), code_digest()), not options.no_peer
    nums = options.num or (2, 3, 6)
    print("\n".join(HEAD), flush=True)
    lines = []
    for walk in (one.resolve() for one in options.walk):
        for other in options.other:
            lines += of_pair(bench, walk, other.resolve(), options.step)
        for num in nums:
            lines += of_walk(bench, walk, Variant(num, options.step), peer)
        if 2 in nums:
            lines += of_walk(bench, walk, Variant(2, options.step, (0.7, 1.3)), peer)
    for walk, again in options.changed:
        variant = Variant(2, options.step, changed=again.resolve())
        lines += of_walk(bench, walk.resolve(), variant, peer)
    foot = (
        "ATE: of all frames of the exported map after one alignment to the truth; other maps: "
        "frames of each (its ATE). Right: all frames in one map, whose error is at most "
        f"{MAX_RATIO} times that of the best recording refined alone from its trajectory. Each, of "
        "alone: error of each recording's frames in that map, aligned by themselves, over that of "
        "the recording refined alone, least and largest. Start: "
        "trajectories = each its own with drift; half = every other recording's; none = images "
        "alone; COLMAP = spherical, incremental, all pictures."
    )
    print("\n" + foot)
    head = ["# Several recordings in one run", "", *HEAD]
    write_table([*head, *(text for text, _ in lines), "", foot], options.markdown)
    sys.exit(any("**" in found for _, found in lines))


if __name__ == "__main__":
    main()
