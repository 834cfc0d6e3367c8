"""Odometry on sequences with exact truth, without and with faults.

    python benchmarks/odometry.py WALK... --markdown benchmarks/results/odometry.md

WALK is a folder with `images/` (2:1, named by frame number) and `groundtruth.tum`, as dense as a
video: `shared/tools/render_home.py` and `render_walk.py` make such. Odometry runs on each whole
sequence (with the carrier masked), and on its first 90 frames with faults: darkness, a hand, a
standing camera, rotation on the spot, missing frames. Times are processor times of this process
without decoding.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from common import write_table
from scipy.spatial.transform import Rotation

from gsba import odometry
from gsba.camera.sphere import around_sphere, bearings_from_erp, erp_from_bearings
from gsba.evaluate.trajectory import evaluate
from gsba.frames.scan import scan
from gsba.geometry import inverse
from gsba.odometry.panoramas import SmallPanoramas
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

WIDTH = 800
FIRST = 90  # frames of a walk for the rows with faults
AT, LASTING = 40, 10  # frame at which a fault begins, and frames that it lasts
TURN_DEG = 10.0  # a frame


class Row(NamedTuple):
    """Result of one sequence."""

    name: str
    frames: int
    lost: str  # frames without a pose
    maps: int
    keyframes: int
    errors: str  # ATE of each map, per cent of its path
    ms: float  # processor time a frame


def follow(name: str, panoramas: SmallPanoramas, truth: np.ndarray) -> Row:
    """Odometry of a sequence, each map compared with the truth (F, 4, 4)."""
    found = odometry.track_panoramas(panoramas)
    errors = []
    for piece in found.pieces():
        rows = np.searchsorted(found.timestamps, piece.timestamps)
        true = truth[rows]
        path = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
        ate = evaluate(piece, Trajectory(piece.timestamps, true)).ate.rmse
        errors.append(f"{100 * ate / path:.2f}")
    lost = ", ".join(
        f"{np.searchsorted(found.timestamps, s.first_s)} to "
        f"{np.searchsorted(found.timestamps, s.last_s)}"
        for s in found.lost()
    )
    keyframes = int((found.keyframes & found.posed()).sum())
    ms = float(1e3 * found.cpu_s / len(found))
    return Row(name, len(found), lost or "none", len(errors), keyframes, ", ".join(errors), ms)


class LoopRow(NamedTuple):
    """Errors of one sequence before and after loop closure."""

    name: str
    loops: int
    joins: int
    before: str  # ATE of each map, per cent of its path
    after: str
    over_sigma: str  # RMS errors of positions over their standard deviations, of each map
    seconds: float  # processor time of closing


def close_loops(name: str, panoramas: SmallPanoramas, truth: np.ndarray) -> LoopRow:
    """Odometry of a sequence before and after loop closure, compared with the truth (F, 4, 4)."""
    before = odometry.track_panoramas(panoramas, with_loops=False)
    after = odometry.track_panoramas(panoramas)
    ates = []
    for found in (before, after):
        each = []
        for number in range(1, found.maps_in_turn().max() + 1):
            rows = np.flatnonzero(found.maps_in_turn() == number)
            times, true = found.timestamps[rows], truth[rows]
            path = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
            poses = Trajectory(times, found.world_T_rigs[rows])
            each.append(f"{100 * evaluate(poses, Trajectory(times, true)).ate.rmse / path:.2f}")
        ates.append(", ".join(each))
    over = ", ".join(
        f"{_over_sigma(after, np.flatnonzero(after.maps_in_turn() == number), truth):.1f}"
        for number in range(1, after.maps_in_turn().max() + 1)
    )
    counts = len(after.loops), len(after.joins)
    return LoopRow(name, *counts, ates[0], ates[1], over, after.closing_cpu_s)


def _over_sigma(found: odometry.Odometry, rows: np.ndarray, truth: np.ndarray) -> float:
    """RMS of position errors over standard deviations, in the gauge of the covariances, which fixes
    the map's first pose and its distance to the furthest."""
    assert found.covariances is not None
    poses, covariances = found.world_T_rigs[rows], found.covariances[rows]
    true = poses[0] @ inverse(truth[rows[0]]) @ truth[rows]
    offsets, wanted = (some[1:, :3, 3] - poses[0, :3, 3] for some in (poses, true))
    lengths = np.linalg.norm(offsets, axis=1)
    far = int(np.argmax(lengths))
    wanted = wanted * (lengths[far] / np.linalg.norm(wanted[far]))
    errors = np.linalg.norm(wanted - offsets, axis=1)
    sigmas = np.sqrt(np.trace(covariances[1:, 3:, 3:], axis1=1, axis2=2))
    return float(np.sqrt(np.mean((errors / sigmas) ** 2)))


def in_memory(panoramas: SmallPanoramas, pictures: list[np.ndarray]) -> SmallPanoramas:
    """Sequence of images (h, 2h) uint8 in memory."""
    times = np.arange(len(pictures)) / 8.0
    read = lambda rows, _: ((row, pictures[row]) for row in rows)  # noqa: E731
    return replace(panoramas, timestamps=times, read=read)


def turned(grey: np.ndarray, rig_R_turned: np.ndarray) -> np.ndarray:
    """Image of a rotated camera."""
    height, width = grey.shape
    v, u = np.mgrid[:height, :width] + 0.5
    rays = bearings_from_erp(np.stack([u, v], axis=-1), width, height) @ rig_R_turned.T
    u, v = np.moveaxis(erp_from_bearings(rays, width, height) + 1.5, -1, 0).astype(np.float32)
    return cv2.remap(around_sphere(grey, 2), u, v, cv2.INTER_LINEAR)


def faults(name: str, panoramas: SmallPanoramas, truth: np.ndarray) -> list[Row]:
    """Rows of the first frames of a sequence, with each fault."""
    pictures = [picture for _, picture in panoramas.read(range(FIRST), False)]
    rng = np.random.default_rng(0)
    spoilt = range(AT, AT + LASTING)
    standing = [*range(AT), *[AT] * LASTING, *range(AT, FIRST)]
    dark = [np.clip(rng.normal(4, 2, p.shape), 0, 255).astype(np.uint8) for p in pictures[:LASTING]]
    blob = cv2.GaussianBlur(rng.integers(0, 255, pictures[0].shape).astype(np.uint8), (0, 0), 3)
    hand = [p.copy() for p in pictures]
    for n in spoilt:
        hand[n][:, : WIDTH // 2] = blob[:, : WIDTH // 2]
    angles = np.clip(np.arange(len(standing)) - AT, 0, LASTING) * np.deg2rad(TURN_DEG)
    rotations = Rotation.from_rotvec(angles[:, None] * np.array([[0.0, 1.0, 0.0]])).as_matrix()
    spun = [turned(pictures[i], r) for i, r in zip(standing, rotations, strict=True)]
    spun_truth = truth[standing].copy()
    spun_truth[:, :3, :3] = spun_truth[:, :3, :3] @ rotations
    unmasked = replace(panoramas, usable=None)
    still = [*pictures[:AT], *dark, *pictures[AT:]]
    walking = [*pictures[:AT], *dark, *pictures[AT + LASTING :]]
    cases = [
        ("dark while standing", panoramas, still, truth[standing]),
        ("dark while walking", panoramas, walking, truth[:FIRST]),
        ("half covered by a hand", panoramas, hand, truth[:FIRST]),
        ("standing", panoramas, [pictures[i] for i in standing], truth[standing]),
        (f"turning {TURN_DEG:g} deg a frame, no mask", unmasked, spun, spun_truth),
        ("every second frame", panoramas, pictures[::2], truth[:FIRST:2]),
    ]
    return [
        follow(f"{name}, first {FIRST}: {what}", in_memory(source, some), true)
        for what, source, some, true in cases
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="+", type=Path)
    parser.add_argument("--markdown", type=Path)
    parser.add_argument(
        "--loops", action="store_true", help="only compare before and after loop closure"
    )
    arguments = parser.parse_args()
    rows = []
    for n, folder in enumerate(arguments.walks):
        frames = scan(folder / "images", fps=8.0, order_suffices=True)
        panoramas = odometry.of_frames(frames, folder, WIDTH)
        panoramas = odometry.without_carrier(panoramas)
        truth = read_trajectory(folder / "groundtruth.tum").world_T_rigs
        if arguments.loops:
            print(close_loops(folder.name, panoramas, truth), flush=True)
            continue
        rows.append(follow(folder.name, panoramas, truth))
        if n == 0:
            rows += faults(folder.name, panoramas, truth)
    if arguments.loops:
        return
    head = "| sequence | frames | lost | maps | keyframes | ATE, % of the path | ms a frame |"
    lines = [head, "|---|---:|---|---:|---:|---|---:|"]
    for row in rows:
        values = [*row[:-1], f"{row.ms:.0f}"]
        lines.append("| " + " | ".join(str(value) for value in values) + " |")
    print("\n".join(lines))
    write_table(["# Odometry alone", "", *lines], arguments.markdown)


if __name__ == "__main__":
    main()
