"""A run measured on a scan: near where its points are, far where they were before."""

import dataclasses
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from plain_records import frames_of, map_of
from scan_world import HALL, INTO_SCAN, SIZE, cloud, scan
from scipy.spatial.transform import Rotation
from synthetic import unit
from walk_on_earth import frame_set, geodetic_of, level_metres, walk_result, write_fixes

from gsba.cli import results
from gsba.config import GpsSettings, PlacementSettings
from gsba.evaluate import scans
from gsba.evaluate.scans import format_scan, scan_errors
from gsba.geometry import pose
from gsba.placement import guess_in_scan
from gsba.scans.search import Guess
from gsba.scans.types import Scan
from gsba.similarity import Sim3
from gsba.trajectory.files import write_tum
from gsba.types import PictureFormat, Reconstruction, Trajectory


def _run() -> Reconstruction:
    """Points of a hall, each seen from three of twelve frames that have one heading."""
    seen = cloud(SIZE, HALL, 0, num=1500)
    rng = np.random.default_rng(1)
    positions = rng.uniform([1, 1.5, 1], [5, 2.4, 1.6], (12, 3))
    frames = np.sort(rng.permuted(np.tile(np.arange(12), (1500, 1)), axis=1)[:, :3], axis=1).ravel()
    owners = np.repeat(np.arange(1500), 3)
    rays = unit(seen.points[owners] - positions[frames])
    poses = pose(np.tile(np.eye(3), (12, 1, 1)), positions)
    return map_of(poses, seen.points, owners, frames, rays, 5e-4)


def test_distances_after_and_before(monkeypatch: pytest.MonkeyPatch) -> None:
    run, surfaces = _run(), scan(SIZE, HALL, 0, missing=0.0)
    exact = cloud(SIZE, HALL, 0, num=1500)
    rows = {tuple(p): n for p, n in zip(exact.points, exact.normals, strict=True)}
    monkeypatch.setattr(
        scans, "normals_of", lambda points: np.array([rows[tuple(p)] for p in points])
    )
    near = partial(scans.register, guess=Guess(similarity=INTO_SCAN))  # where it is searched for
    monkeypatch.setattr(scans, "register", lambda cloud, scan, _: near(cloud, scan))
    coarse = run.world_T_rigs.copy()
    coarse[:, :3, 3] += np.random.default_rng(2).normal(0, 0.05, (12, 3))
    errors = scan_errors(run, surfaces, coarse)
    np.testing.assert_allclose(errors.registration.fit.similarity.scale, INTO_SCAN.scale, rtol=1e-3)
    assert errors.after.median < 0.01 * INTO_SCAN.scale < errors.before.median
    content = errors.to_json()
    for part in (content["after"], content["before"]):
        assert sum(part["histogram"]["counts"]) == part["points"]
    assert content["registration"]["doubt"] is None or content["registration"]["rivals"]
    colors = errors.colors()
    near, far = np.argmin(errors.after.values), np.argmax(errors.after.values)
    assert colors[near, 2] > colors[near, 0] and colors[far, 0] > colors[far, 2]
    assert "before" in format_scan(errors)
    monkeypatch.setattr(scans, "register", lambda *_, **__: errors.registration)  # as before
    alone = scan_errors(dataclasses.replace(run), surfaces)
    assert alone.before is None and alone.to_json()["before"] is None


def test_pairs_tell_where_to_look(tmp_path: Path) -> None:
    """In the world of the scan's file, whose offset is kept apart."""
    run, pairs = _run(), tmp_path / "pairs.txt"
    picked = run.world_T_rigs[:4, :3, 3]
    lines = zip(picked.tolist(), INTO_SCAN.points(picked).tolist(), strict=True)
    pairs.write_text(
        "".join(f"{','.join(map(repr, a))} {','.join(map(repr, b))}\n" for a, b in lines)
    )
    frames = frames_of(PictureFormat("erp", 64, 32), ((),) * 12)
    offset = np.array([5.0, -7.0, 11.0])
    far = Scan(np.zeros((1, 3)), np.ones((1, 3)), offset)
    known = PlacementSettings(scan="scan.ply", pairs=str(pairs))
    guess, grounds = guess_in_scan(run, frames, known, far)
    assert guess.similarity is not None and grounds == {"pairs": str(pairs)}
    np.testing.assert_allclose(guess.similarity.scale, INTO_SCAN.scale)
    moved = INTO_SCAN.translation - offset
    np.testing.assert_allclose(guess.similarity.translation, moved, atol=1e-9)
    nothing, _ = guess_in_scan(run, frames, PlacementSettings(scan="scan.ply"), far)
    assert nothing == Guess()


def test_positions_that_start_the_fit_have_their_own_clock_and_noise(tmp_path: Path) -> None:
    """As in a placement by GPS: the seconds to add to their times, the noise of the receiver."""
    run, frames = walk_result(), frame_set(40)
    late = write_fixes(
        tmp_path / "late.csv", frames.timestamps + 1000, geodetic_of(level_metres(run))
    )
    known = PlacementSettings(scan="scan.ply", gps=str(late))
    nothing = Scan(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(3))
    receiver = GpsSettings(offset_s=-1000.0, sigma_m=0.5, sigma_up_m=0.5)
    guess, _ = guess_in_scan(run, frames, known, nothing, receiver)
    assert guess.scale == pytest.approx(1 / 0.21, rel=1e-3)


@pytest.mark.parametrize("sigma", [0.1, 6.0])
def test_a_start_by_positions_is_as_wide_as_they_are_uncertain(
    tmp_path: Path, sigma: float
) -> None:
    """Noise of metres on a walk of 30 rules the true place out neither by scale nor by heading."""
    run, frames = walk_result(), frame_set(40)
    true = Sim3(1 / 0.21, Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix().T)
    known = PlacementSettings(scan="scan.ply", gps=str(tmp_path / "gps.csv"))
    nothing = Scan(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(3))
    receiver = GpsSettings(sigma_m=sigma, sigma_up_m=sigma)
    apart = np.abs(frames.timestamps[:, None] - frames.timestamps) / 60.0  # errors last a minute
    mixed = sigma * np.linalg.cholesky(0.1 * np.eye(40) + 0.9 * np.exp(-apart))
    for seed in range(8):
        off = mixed @ np.random.default_rng(seed).normal(size=(40, 3))
        write_fixes(tmp_path / "gps.csv", frames.timestamps, geodetic_of(level_metres(run) + off))
        guess, _ = guess_in_scan(run, frames, known, nothing, receiver)
        assert guess.allows(true)
        if sigma < 1:
            assert guess.scale is not None and guess.rotation is not None
            assert (guess.scale_ratio, guess.angle_deg) == (Guess().scale_ratio, Guess().angle_deg)


def test_a_scan_and_a_truth_are_both_in_the_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = {"scan": "hall.ply", "after": {"median": 0.004}}
    monkeypatch.setattr(results, "_against_scan", lambda *_: measured)
    write_tum(tmp_path / "a.tum", Trajectory(np.arange(12.0), _run().world_T_rigs))
    given = {"scan": Path("hall.ply"), "json_file": tmp_path / "errors.json"}
    results.evaluate(tmp_path / "a.tum", tmp_path / "a.tum", **given)
    both = json.loads((tmp_path / "errors.json").read_text())
    assert both["scan"] == measured and both["ate"]["rmse"] < 1e-9
    results.evaluate(tmp_path / "a.tum", **given)
    assert json.loads((tmp_path / "errors.json").read_text()) == measured
