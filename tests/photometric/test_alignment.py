"""The alignment stage on a rendered walk: better poses, right bookkeeping, bad frames survived."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from plain_records import frames_of
from synthetic import bearings_of, keypoints_of, unit

from gsba.bundle import adjustment
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_directions
from gsba.config import RefineSettings
from gsba.frames.panorama import Greys
from gsba.geometry import inverse, pose
from gsba.photometric import alignment, frame_jobs, packing
from gsba.photometric.alignment import AlignedObservations
from gsba.store.shards import Threads
from gsba.types import (
    FACES,
    Counts,
    FrameSet,
    Keypoints,
    Landmarks,
    PictureFormat,
    Sighted,
    Solution,
    Tracks,
)

NUM, WIDTH = 6, 512
RIG = CubeRig(128, np.pi / 2)
PIXEL = 2 * np.pi / WIDTH
in_small_patches = partial(AlignedObservations, patch_size=11)


def _grey(points: np.ndarray) -> np.ndarray:
    """Texture of space: waves a little longer than two pixels seen from 3 units away."""
    rng = np.random.default_rng(0)
    out = np.full(points.shape[:-1], 128.0)
    for _ in range(60):
        wave = rng.normal(size=3)
        wave *= rng.uniform(0.15, 1) * 2 * np.pi / (5 * PIXEL * 3) / np.linalg.norm(wave)
        out += 7 * np.sin(points @ wave + rng.uniform(0, 2 * np.pi))
    return out


def _hit(centre: np.ndarray, rays: np.ndarray, radius: float = 3.0) -> np.ndarray:
    """Where rays (..., 3) from inside leave a sphere around the origin."""
    along = rays @ centre
    return centre + (np.sqrt(along**2 + radius**2 - centre @ centre) - along)[..., None] * rays


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> tuple[FrameSet, np.ndarray]:
    """Panoramas inside a textured sphere, and their true poses."""
    folder = tmp_path_factory.mktemp("frames")
    rays = erp_directions(WIDTH)
    at = np.linspace(-0.7, 0.7, NUM)
    positions = np.column_stack([at, 0.1 * np.sin(4 * at), 0.3 * at**2])
    turns = np.array([cv2.Rodrigues(np.array([0.02, 0.3, 0.01]) * a)[0] for a in at])
    world_T_rigs, paths = pose(turns, positions), []
    rng = np.random.default_rng(1)
    for f in range(NUM):
        image = _grey(_hit(positions[f], rays @ turns[f].T)) + rng.normal(0, 2, rays.shape[:2])
        paths.append((folder / f"{f}.png",))
        cv2.imwrite(str(paths[-1][0]), np.clip(image * (1 + 0.05 * f) - 5 * f, 0, 255))
    return frames_of(PictureFormat("erp", WIDTH, WIDTH // 2), paths), world_T_rigs


def _start(
    world_T_rigs: np.ndarray, sigma_px: float = 0.3, num: int = 400
) -> tuple[Landmarks, Keypoints]:
    """Points on the sphere, seen by three frames each with a detector's noise."""
    rng = np.random.default_rng(2)
    rays = rng.normal(size=(num, 3))
    points = 3 * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    chosen = np.sort(np.argsort(rng.random((num, NUM)), axis=1)[:, :3], axis=1)
    owners, frames = np.repeat(np.arange(num), 3), chosen.ravel()
    order = np.lexsort((owners, frames))
    starts = np.searchsorted(frames[order], np.arange(NUM + 1))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    bearings = np.empty((len(order), 3))
    for f in range(NUM):
        rows = order[starts[f] : starts[f + 1]]
        bearings[starts[f] : starts[f + 1]] = bearings_of(points[owners[rows]], world_T_rigs[f])
    bearings += rng.normal(0, sigma_px * PIXEL, bearings.shape)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    keypoints = keypoints_of(starts, bearings, sigma_px * PIXEL)
    tracks = Tracks(
        owners.astype(np.int32), frames.astype(np.int32),
        (rank - starts[frames]).astype(np.int32), num,
    )  # fmt: skip
    return Landmarks(points, tracks, Counts(num, num, "tracks")), keypoints


def _run(
    walk: tuple[FrameSet, np.ndarray],
    sigma_px: float = 0.3,
    aligned: np.ndarray | None = None,
    folder: Path | None = None,
) -> Sighted:
    frames, world_T_rigs = walk
    landmarks, keypoints = _start(world_T_rigs, sigma_px)
    solved = _solved(landmarks, world_T_rigs)
    observed = in_small_patches(keypoints, aligned=aligned, folder=folder)
    return alignment.align(solved, observed, Greys(frames, 4096), RIG, Threads(2))


def _solved(landmarks: Landmarks, world_T_rigs: np.ndarray) -> Solution:
    return replace(Solution.without_points(world_T_rigs), landmarks=landmarks)


def _errors_px(sighted: Sighted, world_T_rigs: np.ndarray) -> np.ndarray:
    """Angles between observations and the true directions of the points they are of."""
    landmarks, _ = _start(world_T_rigs)
    # The stage keeps the order of points; those it lost are found by the nearest direction.
    tracks, keypoints = sighted.tracks, sighted.keypoints
    found = keypoints.bearings_rig[keypoints.rows(tracks)]
    errors = np.empty(len(tracks))
    for f in range(NUM):
        rows = np.flatnonzero(tracks.frames == f)
        true = bearings_of(landmarks.points_world, world_T_rigs[f])
        errors[rows] = np.arccos(np.clip(found[rows] @ true.T, -1, 1)).min(axis=1)
    return errors[sighted.aligned[keypoints.rows(tracks)]] / PIXEL


def test_observations_are_sub_pixel(walk) -> None:
    sighted = _run(walk)
    errors = _errors_px(sighted, walk[1])
    assert len(errors) > 3 * 400  # more than the detector's: points were found in further frames
    assert np.median(errors) < 0.06 and np.percentile(errors, 95) < 0.3
    counts = sighted.counts
    assert counts.received == counts.kept + sum(counts.dropped.values())


def test_patches_held_together_are_of_frames_near_one_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(alignment, "total_memory_bytes", lambda: 64 * alignment._PATCH_BYTES * 50)
    along = np.tile(np.linspace(0, 1, 100), 2)  # two laps
    positions = np.column_stack([along, 0 * along, 0.01 * along])
    parts = list(alignment._by_hosts(np.arange(200), positions))
    assert [len(part) for part in parts] == [50] * 4
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(200))
    assert max(np.ptp(along[part]) for part in parts) < 0.26


def test_patches_of_some_points_at_a_time_give_the_same_bytes(
    walk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    expected, cut = _run(walk), frame_jobs.cut
    held: list[int] = []

    def counting(title: str, greys: Greys, hosts: np.ndarray, *rest: Any) -> Any:
        held.append(len(hosts))
        return cut(title, greys, hosts, *rest)

    monkeypatch.setattr(frame_jobs, "cut", counting)
    monkeypatch.setattr(alignment, "total_memory_bytes", lambda: 64 * alignment._PATCH_BYTES * 90)
    monkeypatch.setattr(alignment, "_POINTS_AT_ONCE", 70)
    monkeypatch.setattr(packing, "_POINTS_AT_ONCE", 50)
    monkeypatch.setattr(packing, "_FRAMES_AT_ONCE", 2)
    found = _run(walk, folder=tmp_path)
    assert held == [90, 90, 90, 90, 40]
    for name in ("starts", "bearings_rig", "sqrt_infos", "colors", "pixels"):
        np.testing.assert_array_equal(
            getattr(found.keypoints, name), getattr(expected.keypoints, name)
        )
    for name in ("points", "frames", "keypoints"):
        np.testing.assert_array_equal(getattr(found.tracks, name), getattr(expected.tracks, name))
    np.testing.assert_array_equal(found.normals_rig, expected.normals_rig)
    np.testing.assert_array_equal(found.aligned, expected.aligned)
    assert found.counts == expected.counts


def test_tracks_and_keypoints_belong_together(walk) -> None:
    sighted = _run(walk)
    tracks, keypoints = sighted.tracks, sighted.keypoints
    rows = keypoints.rows(tracks)
    assert sorted(rows) == list(range(len(keypoints.faces)))
    assert np.all(np.diff(tracks.points) >= 0)
    assert np.bincount(tracks.points).min() >= 2
    cells = tracks.points.astype(int) * NUM + tracks.frames
    assert len(np.unique(cells)) == len(cells)
    np.testing.assert_allclose(RIG.bearings(keypoints.pixels, keypoints.faces),
                               keypoints.bearings_rig, atol=1e-12)  # fmt: skip
    assert keypoints.sqrt_infos is not None
    determinant = np.linalg.det(keypoints.sqrt_infos)
    np.testing.assert_allclose(determinant, keypoints.sigmas_rad**-2, rtol=1e-9)
    assert (keypoints.colors == 128).all()


def test_poses_become_better_than_the_detector_leaves_them(walk) -> None:
    frames, world_T_rigs = walk
    landmarks, keypoints = _start(world_T_rigs)
    settings = RefineSettings()
    priors = TrajectoryPrior(world_T_rigs, settings.priors)

    def rotation_errors(solved: Solution) -> np.ndarray:
        true = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
        found = inverse(solved.world_T_rigs[:-1]) @ solved.world_T_rigs[1:]
        return np.linalg.norm(found[:, :3, :3] - true[:, :3, :3], axis=(1, 2))

    start = replace(Solution.without_points(world_T_rigs), landmarks=landmarks)
    problem, gates = AdjustmentContext(Families((Bearings(), priors)), RIG, settings, 2), (6.0, 3.0)
    before = adjustment.adjust(landmarks.tracks, keypoints, start, problem, gates)
    greys, workers = Greys(frames, 4096), Threads(2)
    sighted = alignment.align(before, in_small_patches(keypoints), greys, RIG, workers)
    after, known = adjustment.adjust_sighted(sighted, before, problem, gates)
    assert np.median(rotation_errors(after)) < 0.5 * np.median(rotation_errors(before))
    assert 0.5 <= after.noise < 2 and all(step.accepted for step in after.rounds)
    aligned = sighted.aligned
    factor = known.sigmas_rad[aligned] / sighted.keypoints.sigmas_rad[aligned]
    np.testing.assert_allclose(factor, factor[0])  # one for all, found from their residuals


@pytest.mark.parametrize("grey", [0, 255])
def test_a_frame_without_texture_keeps_what_it_had(walk, tmp_path: Path, grey: int) -> None:
    frames, world_T_rigs = walk
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((WIDTH // 2, WIDTH), grey, np.uint8))
    paths = (*frames.paths[:2], (blank,), *frames.paths[3:])
    sighted = _run((replace(frames, paths=paths), world_T_rigs))
    assert sighted.counts.dropped["no texture"] > 50
    seen = np.bincount(sighted.tracks.frames, minlength=NUM)
    assert seen.min() > 100
    assert not sighted.aligned[slice(*sighted.keypoints.starts[2:4])].any()
    infos = sighted.keypoints.sqrt_infos
    assert infos is not None and np.isfinite(infos).all()


def test_all_masked_leaves_the_former_observations(walk, tmp_path: Path) -> None:
    frames, world_T_rigs = walk
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.zeros((WIDTH // 2, WIDTH), np.uint8))
    sighted = _run((replace(frames, mask_paths=(mask,) * NUM), world_T_rigs))
    landmarks, keypoints = _start(world_T_rigs)
    assert sighted.counts.kept == 0
    assert sighted.counts.dropped["masked"] == sighted.counts.received
    assert len(sighted.tracks) == len(landmarks.tracks) and not sighted.aligned.any()
    np.testing.assert_allclose(sighted.keypoints.sigmas_rad, keypoints.sigmas_rad)


def test_points_at_a_centre_and_behind_walls_do_no_harm(walk) -> None:
    frames, world_T_rigs = walk
    landmarks, keypoints = _start(world_T_rigs)
    points = landmarks.points_world.copy()
    points[:50] *= 1e-9  # inside the camera's path
    points[50:100] *= 50
    points[100] = world_T_rigs[landmarks.tracks.frames[300], :3, 3]
    moved = replace(landmarks, points_world=points)
    solved, greys = _solved(moved, world_T_rigs), Greys(frames, 4096)
    observed, workers = in_small_patches(keypoints), Threads(2)
    sighted = alignment.align(solved, observed, greys, RIG, workers)
    assert np.isfinite(sighted.keypoints.bearings_rig).all()
    infos = sighted.keypoints.sqrt_infos
    assert infos is not None and np.isfinite(infos).all()


def test_confirmed_points_are_looked_for_elsewhere(walk, monkeypatch: pytest.MonkeyPatch) -> None:
    _, keypoints = _start(walk[1])
    monkeypatch.setattr(alignment, "_MIN_TRACK_LENGTH", 4)  # longer than any here
    short, confirmed = (
        _run(walk, aligned=aligned) for aligned in (None, np.ones(len(keypoints.faces), bool))
    )
    assert short.counts.received == 2 * 400  # all observations but the references
    assert confirmed.counts.received > 3 * 400


def test_a_solution_that_loses_a_frame_is_told_apart(walk) -> None:
    _, world_T_rigs = walk
    landmarks, _ = _start(world_T_rigs)
    before = replace(Solution.without_points(world_T_rigs), landmarks=landmarks)
    tracks = landmarks.tracks
    rows = tracks.frames != 3
    fewer = Tracks(tracks.points[rows], tracks.frames[rows], tracks.keypoints[rows], 400)
    without = replace(before, landmarks=replace(landmarks, tracks=fewer))
    assert before.carries(before, 12) and before.carries(without, 12)
    assert not without.carries(before, 12)


def test_no_points_are_no_observations(walk) -> None:
    frames, world_T_rigs = walk
    none = Solution.without_points(world_T_rigs).landmarks
    _, keypoints = _start(world_T_rigs)
    solved, greys = _solved(none, world_T_rigs), Greys(frames, 4096)
    observed, workers = in_small_patches(keypoints), Threads(2)
    sighted = alignment.align(solved, observed, greys, RIG, workers)
    assert len(sighted.tracks) == 0 and sighted.counts.received == 0


def test_cube_faces_are_aligned_like_panoramas(walk, tmp_path: Path) -> None:
    """Faces cut from the same scene; observations near face edges are as good as others."""
    frames, world_T_rigs = walk
    size = 160
    rig = CubeRig(size, np.pi / 2)
    centres = np.arange(size) + 0.5
    grid = np.stack(np.meshgrid(centres, centres), axis=-1)
    paths = []
    for f in range(NUM):
        group = []
        for face in range(len(FACES)):
            rays = rig.bearings(grid, face) @ world_T_rigs[f, :3, :3].T
            group.append(tmp_path / f"{f}_{face}.png")
            image = _grey(_hit(world_T_rigs[f, :3, 3], rays))
            cv2.imwrite(str(group[-1]), np.clip(image, 0, 255))
        paths.append(tuple(group))
    cube = replace(frames, paths=tuple(paths), formats=(PictureFormat("cube", size, size, FACES),))
    sighted = _run((cube, world_T_rigs))
    errors = _errors_px(sighted, world_T_rigs)
    rows = sighted.keypoints.rows(sighted.tracks)
    rows = rows[sighted.aligned[rows]]
    pixels = sighted.keypoints.pixels[rows] / RIG.size
    edge = np.abs(pixels - 0.5).max(axis=1) > 0.47
    assert len(errors) > 900 and np.median(errors) < 0.08
    assert np.count_nonzero(edge) > 50 and np.median(errors[edge]) < 0.1


def _walls(centre: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (..., 3) hit the walls of a corridor along x, and their normals, outwards."""
    ranges = (np.sign(rays[..., 1:]) - centre[1:]) / rays[..., 1:]
    nearest = ranges.argmin(axis=-1)
    hits = centre + np.take_along_axis(ranges, nearest[..., None], axis=-1) * rays
    return hits, np.sign(rays) * np.eye(3)[1 + nearest]


def test_patches_come_to_lie_on_their_surfaces(tmp_path: Path) -> None:
    """Walls that pass by askew: found once as if they faced the host, then as they lie."""
    rng, rays, paths = np.random.default_rng(3), erp_directions(WIDTH), []
    world_T_rigs = np.tile(np.eye(4), (NUM, 1, 1))
    world_T_rigs[:, 0, 3] = np.linspace(-0.75, 0.75, NUM)
    for f, centre in enumerate(world_T_rigs[:, :3, 3]):
        image = _grey(2.5 * _walls(centre, rays)[0]) + rng.normal(0, 2, rays.shape[:2])
        paths.append((tmp_path / f"{f}.png",))
        cv2.imwrite(str(paths[-1][0]), np.clip(image, 0, 255))
    frames = frames_of(PictureFormat("erp", WIDTH, WIDTH // 2), paths)
    landmarks, keypoints = _start(world_T_rigs, num=800)
    outwards = landmarks.points_world * np.array([0.4, 1, 1])  # towards the walls beside the walk
    points, true = _walls(np.zeros(3), outwards / np.linalg.norm(outwards, axis=1, keepdims=True))
    clear = np.sort(np.abs(points[:, 1:]), axis=1)[:, 0] < 0.7  # of the corridor's edges
    landmarks = replace(landmarks, points_world=points)
    tracks, errors, normals = landmarks.tracks, [], None
    bearings = keypoints.bearings_rig.copy()
    for f in range(NUM):
        rows = np.flatnonzero(tracks.frames == f)
        towards = points[tracks.points[rows]]
        bearings[keypoints.rows(tracks)[rows]] = bearings_of(towards, world_T_rigs[f])
    keypoints = replace(keypoints, bearings_rig=bearings)
    for _ in range(2):
        solved, observed = (
            _solved(landmarks, world_T_rigs),
            in_small_patches(keypoints, normals_rig=normals),
        )
        greys, workers = Greys(frames, 4096), Threads(2)
        found = alignment.align(solved, observed, greys, RIG, workers)
        own = found.keypoints.rows(found.tracks)
        where, there = found.keypoints.bearings_rig[own], found.tracks.frames
        shown = [_walls(world_T_rigs[f, :3, 3], b) for f, b in zip(there, where, strict=True)]
        hits, walls = (np.array(column) for column in zip(*shown, strict=True))
        apart = np.linalg.norm(hits[:, None] - points, axis=2)
        nearest = apart.argmin(axis=1)
        good = clear[nearest] & found.aligned[own] & (apart.min(axis=1) < 0.1)
        wanted = unit(points[nearest] - world_T_rigs[there, :3, 3])
        errors.append(np.median(np.linalg.norm(where - wanted, axis=1)[good]) / PIXEL)
        lies = found.normals_rig[own][good]
        known = lies.any(axis=1)
        cosines = np.einsum("oi,oi->o", lies[known], walls[good][known])
        tilts = np.degrees(np.arccos(np.clip(cosines / np.linalg.norm(lies[known], axis=1), -1, 1)))
        assert known.mean() > 0.8 and np.median(tilts) < 15
        normals = np.zeros_like(keypoints.bearings_rig)
        normals[keypoints.rows(tracks)] = true[tracks.points]
    assert errors[1] < 0.7 * errors[0]
