"""The demo's walk: geometry of its renderer, its files, its SLAM-like errors."""

import csv
import json
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
import pytest
from command import run_gsba, succeed
from scipy.spatial.transform import Rotation
from synthetic import unit

from gsba import pipeline
from gsba.camera.lens import Lenses
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.cli.refining import _found_lenses
from gsba.demo import degrade, make_walk
from gsba.demo.degrade import Drift
from gsba.demo.gallery import build_gallery
from gsba.demo.mesh import MeshBuilder
from gsba.demo.raycast import ranges
from gsba.demo.render import render_erp
from gsba.demo.two_lenses import KNOTS, SWEEP, TwoLenses, poses_during, render_stitched
from gsba.demo.walk import walk_poses
from gsba.geometry import inverse, pose, rotation_angle
from gsba.log import GsbaError
from gsba.report.maps import summarize_maps
from gsba.types import Trajectory

WIDTH, FRAMES = 256, 6
TRUTH = walk_poses("rectangle", "locked", 40, seed=0)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo") / "walk"
    return make_walk(out, num_frames=FRAMES, width=WIDTH, seed=3, depth=True)


def _read_tum(path):
    rows = np.loadtxt(path)
    return Trajectory(rows[:, 0], pose(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]))


def _checkers():
    """Checkerboards of two by two fields; their centres are exact image features."""
    mesh = MeshBuilder()
    fields = np.kron([[230, 30], [30, 230]], np.ones((64, 64))).astype(np.uint8)
    board = mesh.texture(np.repeat(fields[..., None], 3, axis=2))
    azimuths, heights = np.radians([0, 50, 110, 170, 230, 300]), (0.0, -0.5, 0.4, 0.8, -0.9, 0.2)
    centers = [
        np.array([2 * np.sin(a), h, 2 * np.cos(a)]) for a, h in zip(azimuths, heights, strict=True)
    ]
    for center, azimuth in zip(centers, azimuths, strict=True):
        facing = (-np.sin(azimuth + 0.4), 0, -np.cos(azimuth + 0.4))
        mesh.panel(center, facing, (0.8, 0.8), board)
    return mesh.build(), np.array(centers)


def _views():
    """Four poses among the checkerboards, all centres well off the seam."""
    rng = np.random.default_rng(0)
    for _ in range(4):
        turn = Rotation.from_euler("YXZ", np.array([0.3, 0, 0]) + rng.normal(0, 0.1, 3))
        yield pose(turn.as_matrix(), rng.normal(0, 0.15, 3))


@pytest.mark.parametrize("width", [512, 1024])
def test_known_points_appear_where_they_project(width):
    scene, points = _checkers()
    errors = []
    for world_T_rig in _views():
        image = render_erp(scene, world_T_rig, width, width // 2)
        points_rig = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
        errors.append(_off(image, erp_from_bearings(points_rig, width, width // 2)))
    _assert_hits(np.concatenate(errors))


def _off(image, expected):
    """By how much (N, 2) the centres of checkerboards lie beside expected pixels (N, 2)."""
    found = cv2.cornerSubPix(
        image.mean(axis=2).astype(np.uint8),
        np.ascontiguousarray(np.round(expected - 0.5)[:, None], dtype=np.float32),
        (4, 4),
        (-1, -1),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4),
    )
    return found[:, 0] + 0.5 - expected


def _assert_hits(errors):
    """Errors (24, 2), or some less, are the finder's noise: 0.05 px, on ideal images too."""
    assert np.abs(errors).max() < 0.25
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.1
    assert np.abs(errors.mean(axis=0)).max() < 0.04  # 0.05 / sqrt(24), thrice


def test_picture_is_the_box_filtered_scene():
    """No shift against a picture of sixteen times the rays, and hardly another value."""
    scene, _ = _checkers()
    width = 512
    for world_T_rig in islice(_views(), 2):
        image = render_erp(scene, world_T_rig, width, width // 2).mean(axis=2)
        large = render_erp(scene, world_T_rig, 4 * width, 2 * width).mean(axis=2)
        ideal = cv2.resize(large, (width, width // 2), interpolation=cv2.INTER_AREA)
        rows = np.stack([g.ravel() for g in np.gradient(ideal)], axis=1)
        shift = np.linalg.lstsq(rows, (ideal - image).ravel())[0]
        assert np.abs(shift).max() < 0.02  # pixels; coverage is told in quarters at edges
        assert np.abs(image - ideal).mean() < 0.15  # of 255


def test_edges_are_antialiased_without_bias():
    mesh = MeshBuilder()
    white = mesh.texture(np.full((4, 4, 3), 255, np.uint8))
    mesh.panel((0.03, 0, 2.0), (0, 0, -1), (1.0, 8.0), white)
    width = 256
    image = render_erp(mesh.build(), np.eye(4), width, width // 2)[..., 0]
    rows = image[width // 4 - 20 : width // 4 + 20]
    left, right = np.arctan2([-0.47, 0.53], 2.0) * width / (2 * np.pi) + width / 2
    columns = np.arange(width) + 0.5
    covered = rows / rows.max()
    assert covered.sum(axis=1) == pytest.approx(right - left, abs=0.26)  # 1/8 pixel per edge
    centroid = (covered * columns).sum() / covered.sum()
    assert centroid == pytest.approx((left + right) / 2, abs=0.13)


def test_hierarchy_finds_what_every_face_tested_alone_finds():
    rng = np.random.default_rng(1)
    mesh = MeshBuilder()
    gray = mesh.texture(np.full((4, 4, 3), 128, np.uint8))
    for k in range(60):
        corner, edge_a, edge_b = rng.uniform(-3, 3, 3), *rng.uniform(-1, 1, (2, 3))
        mesh.face(corner, edge_a, edge_b, gray, triangle=k % 2 == 0)
    scene = mesh.build()
    directions = unit(rng.standard_normal((400, 3)))
    origin = np.array([0.1, 0.2, -0.3])
    best = np.full(len(directions), np.inf)
    for corner, edges, span in zip(scene.corners, scene.edges, scene.spans, strict=True):
        for i, d in enumerate(directions):  # origin + t d = corner + a edge_a + b edge_b
            a, b, t = np.linalg.solve(np.column_stack([*edges, -d]), origin - corner)
            if t > 0 and min(a, b) >= 0 and max(a, b) <= 1 and a + b <= span:
                best[i] = min(best[i], t)
    expected = np.where(np.isinf(best), 0, best)
    assert np.count_nonzero(expected) > 50
    np.testing.assert_allclose(ranges(scene, origin, directions), expected, atol=1e-9)


def test_walk_writes_frames_times_and_trajectories(walk):
    names = [f"{f:06d}.jpg" for f in range(FRAMES)]
    assert sorted(p.name for p in walk.frames_dir.iterdir()) == [*names, "timestamps.csv"]
    with (walk.frames_dir / "timestamps.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == names
    truth, slam = _read_tum(walk.truth_path), _read_tum(walk.slam_path)
    expected = walk_poses("rectangle", "locked", FRAMES, seed=3)
    np.testing.assert_allclose([float(row["timestamp"]) for row in rows], expected.timestamps)
    np.testing.assert_allclose(truth.world_T_rigs, expected.world_T_rigs, atol=1e-8)  # 9 digits
    np.testing.assert_allclose(slam.world_T_rigs[0], np.eye(4), atol=1e-9)
    for name in names:
        image = cv2.imread(str(walk.frames_dir / name))
        assert image.shape == (WIDTH // 2, WIDTH, 3)
        assert 60 < image.mean() < 200  # neither dark nor washed out
        assert image.std() > 25


def test_depth_and_truth_carry_one_frame_into_the_next(walk):
    """Colours seen along frame 0's depth are found again in frame 1 by the true pose alone."""
    truth = _read_tum(walk.truth_path).world_T_rigs
    images = [cv2.imread(str(walk.frames_dir / f"00000{f}.jpg")) for f in (0, 1)]
    small = WIDTH // 4
    with np.load(walk.frames_dir.parent / "depth" / "000000.npz") as file:
        depth = file["range"]
    assert depth.shape == (small // 2, small)
    assert depth.min() > 0  # the gallery is closed
    points_rig = depth[..., None] * erp_directions(small)
    colors = cv2.resize(np.asarray(images[0]), (small, small // 2), interpolation=cv2.INTER_AREA)

    def difference(rig1_T_rig0):
        seen = points_rig @ rig1_T_rig0[:3, :3].T + rig1_T_rig0[:3, 3]
        pixels = erp_from_bearings(seen, WIDTH, WIDTH // 2).astype(np.float32) - 0.5
        blurred = cv2.blur(np.asarray(images[1]), (4, 4))
        other = cv2.remap(blurred, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR)
        return np.median(cv2.absdiff(other, colors))

    motion = inverse(truth[1]) @ truth[0]
    right = difference(motion)
    still, backwards = difference(np.eye(4)), difference(inverse(motion))
    assert right < 0.6 * min(still, backwards)


def test_walk_is_reproducible_and_replaces_only_walks(walk, tmp_path, monkeypatch):
    monkeypatch.setattr("gsba.demo.gallery.build_gallery", build_gallery)  # built anew
    again = make_walk(tmp_path / "again", num_frames=FRAMES, width=WIDTH, seed=3)
    for first, second in ((walk.slam_path, again.slam_path), (walk.truth_path, again.truth_path)):
        assert first.read_bytes() == second.read_bytes()
    name = "000003.jpg"
    assert (walk.frames_dir / name).read_bytes() == (again.frames_dir / name).read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["again"]  # nothing left half-written

    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("years of work")
    with pytest.raises(GsbaError, match="not a walk's folder"):
        make_walk(mine, num_frames=FRAMES, width=WIDTH)
    assert (mine / "thesis.tex").exists()


@pytest.mark.parametrize(
    "setting",
    [
        {"path": "spiral"},
        {"heading": "up"},
        {"camera": "pinhole"},
        {"num_frames": 2},
        {"width": 32},
        {"width": 257},
        {"width": 2**40},
        {"num_frames": 10**9},
    ],
)
def test_walk_refuses_bad_settings(tmp_path, setting):
    with pytest.raises(GsbaError):
        make_walk(tmp_path / "walk", **setting)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["rectangle", "oval", "open"])
@pytest.mark.parametrize("heading", ["locked", "forward"])
def test_walk_poses_follow_their_path(path, heading):
    poses = walk_poses(path, heading, 40, seed=1).world_T_rigs
    positions = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert 20 < steps.sum() < 30
    assert np.ptp(steps) < 0.5 * steps.mean()  # even, up to wobble and corners cut
    gap = np.linalg.norm(positions[-1] - positions[0])
    assert gap > 5 if path == "open" else gap == pytest.approx(steps.mean(), rel=0.3)
    forward, tangent = poses[:, :3, 2], np.gradient(positions, axis=0)[:, [0, 2]]
    if heading == "locked":
        looked_for = np.broadcast_to([0.0, 1.0], tangent.shape)
    else:
        looked_for = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    inside = slice(1, -1)  # one-sided differences at the ends
    along = np.sum(forward[inside][:, [0, 2]] * looked_for[inside], axis=1)
    assert along.min() > np.cos(np.radians(16))  # wobble and corners within a step


def test_degraded_truth_without_errors_is_a_similarity_of_it():
    clean = degrade(TRUTH, scale=0.4, drift=Drift(0, 0, 0), jitter=0)
    expected = inverse(TRUTH.world_T_rigs[0]) @ TRUTH.world_T_rigs
    expected[:, :3, 3] *= 0.4
    np.testing.assert_allclose(clean.world_T_rigs, expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_drift_is_slam_like(seed):
    slam = degrade(TRUTH, seed)
    truth = inverse(TRUTH.world_T_rigs[0]) @ TRUTH.world_T_rigs
    positions = slam.world_T_rigs[:, :3, 3] / 0.4
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    error = np.linalg.norm(positions - truth[:, :3, 3], axis=1)
    assert 0.004 < error.max() / length < 0.04
    angle = rotation_angle(inverse(truth)[:, :3, :3] @ slam.world_T_rigs[:, :3, :3])
    assert 1.7 < np.degrees(angle.max()) < 2.5  # 2 degrees and jitter
    local = inverse(slam.world_T_rigs[:-1]) @ slam.world_T_rigs[1:]
    exact = inverse(truth[:-1]) @ truth[1:]
    turned = rotation_angle(inverse(exact)[:, :3, :3] @ local[:, :3, :3])
    assert np.degrees(np.median(turned)) < 0.3  # right locally
    np.testing.assert_array_equal(slam.world_T_rigs, degrade(TRUTH, seed).world_T_rigs)
    assert not np.allclose(slam.world_T_rigs, degrade(TRUTH, seed + 100).world_T_rigs, atol=1e-4)


def test_jumps_and_lost_frames():
    calm, jumpy = degrade(TRUTH, 2), degrade(TRUTH, 2, num_jumps=3, num_lost=7)
    assert len(calm.timestamps) == 40
    assert len(jumpy.timestamps) == 33
    assert set(jumpy.timestamps) <= set(TRUTH.timestamps)
    assert jumpy.timestamps[0] == TRUTH.timestamps[0]
    assert jumpy.timestamps[-1] == TRUTH.timestamps[-1]
    kept = np.isin(TRUTH.timestamps, jumpy.timestamps)
    exact = TRUTH.world_T_rigs[kept]

    def largest_step_error(world_T_rigs):
        steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
        truth = inverse(exact[:-1]) @ exact[1:]
        return np.linalg.norm(steps[:, :3, 3] / 0.4 - truth[:, :3, 3], axis=1).max()

    jump = largest_step_error(jumpy.world_T_rigs)
    assert jump > 0.25  # half a step of 0.65
    assert jump > 2 * largest_step_error(calm.world_T_rigs[kept])


STILL = TwoLenses(readout_s=0.0, gains=(1.0, 1.0))


def _ahead(width):
    """Angles from the seam towards the front (H, W), degrees."""
    bearings = erp_directions(width)
    return np.degrees(np.arcsin(bearings[..., 2]))


def _at_lens(world_T_rig, side):
    """The pose of the front (1) or back (-1) lens, axes of the rig."""
    offset = side * 0.5 * STILL.baseline * np.array([0, 0, 1.0])
    return world_T_rig @ pose(np.eye(3), offset)


def test_two_lenses_in_one_place_at_one_instant_are_ideal():
    scene, _ = _checkers()
    one_place = replace(STILL, baseline=0.0)
    for world_T_rig in _views():
        ideal = render_erp(scene, world_T_rig, 256, 128)
        frozen = np.broadcast_to(world_T_rig, (KNOTS, 4, 4))
        for world_T_rigs in (world_T_rig[None], frozen):
            image = render_stitched(scene, world_T_rigs, one_place, 256, 128)
            np.testing.assert_array_equal(image, ideal)


def test_each_half_is_of_its_lens_and_the_seam_of_both():
    scene, _ = _checkers()
    world_T_rig, width = next(_views()), 256
    camera = replace(STILL, gains=(1.25, 0.75))
    image = render_stitched(scene, world_T_rig[None], camera, width, width // 2)
    front, back = (
        gain * render_erp(scene, _at_lens(world_T_rig, side), width, width // 2)
        for side, gain in ((1, 1.25), (-1, 0.75))
    )
    ahead, band = _ahead(width), camera.band_deg
    np.testing.assert_allclose(image[ahead > band], front[ahead > band], rtol=1e-6)
    np.testing.assert_allclose(image[ahead < -band], back[ahead < -band], rtol=1e-6)
    within = np.abs(ahead) < band
    share = (0.5 + 0.5 * ahead[within] / band)[:, None]
    mixed = share * front[within] + (1 - share) * back[within]
    np.testing.assert_allclose(image[within], mixed, atol=1e-3)
    assert np.abs(front - back)[within].max() > 30  # there is something to blend


def _seen_from(local, turn, move, camera):
    """Points (N, 3) of the rig where a rig that turns and moves meanwhile shows them, (N, 3)."""
    sides = np.sign(local[:, 2:])
    seen, ends = local, np.radians(camera.half_fov_deg)
    for _ in range(10):
        across = np.linalg.norm(seen[:, :2], axis=1)
        angles = np.arctan2(across, sides[:, 0] * seen[:, 2])
        radii, last = (
            a + camera.bend[0] * a**3 + camera.bend[1] * a**5 for a in (angles, np.float64(ends))
        )
        rows = (0.5 * radii / last * (seen[:, :2] @ SWEEP) / across)[:, None]
        undone = Rotation.from_rotvec(-rows * turn)
        seen = undone.apply(local - rows * move) - sides * [0, 0, camera.baseline / 2]
    return seen


@pytest.mark.parametrize("bend", [(0.0, 0.0), TwoLenses().bend])
def test_rows_are_read_one_after_another_from_their_lens(bend):
    scene, points = _checkers()
    camera, width = replace(STILL, baseline=0.1, bend=bend), 1024
    turn, move = np.radians([1.0, -2.0, 1.5]), np.array([0.15, -0.05, 0.1])  # in a readout
    after = np.linspace(-0.5, 0.5, 65)[:, None]
    moved = pose(Rotation.from_rotvec(after * turn).as_matrix(), after * move)
    lenses = Lenses(
        np.array([0, 0, camera.baseline / 2]),
        row_directions=np.tile([*SWEEP, 0.0], (2, 1)),
        readout_motion=np.concatenate([turn, move])[None],
    )
    errors, shifts = [], []
    for world_T_rig in _views():
        image = render_stitched(scene, world_T_rig @ moved, camera, width, width // 2)
        local = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
        local = local[np.abs(local[:, 2]) > 0.2 * np.linalg.norm(local, axis=1)]  # of one lens
        seen = _seen_from(local, turn, move, camera)
        expected = erp_from_bearings(seen, width, width // 2)
        if not any(bend):  # what a run takes lenses to be
            assumed = lenses.seeing(local, np.zeros(len(local), int))
            by_model = erp_from_bearings(assumed, width, width // 2)
            np.testing.assert_allclose(by_model, expected, atol=1e-3)
        errors.append(_off(image, expected))
        shifts.append(expected - erp_from_bearings(local, width, width // 2))
    _assert_hits(np.concatenate(errors))
    assert np.linalg.norm(np.concatenate(shifts), axis=1).max() > 5  # pixels, from one centre


def test_frames_move_while_they_are_read_and_are_true_in_the_middle():
    still = poses_during(TRUTH, 0.0, 0)
    np.testing.assert_array_equal(still[:, 0], TRUTH.world_T_rigs)
    world_T_rigs = poses_during(TRUTH, 0.012, 0)
    assert world_T_rigs.shape == (40, KNOTS, 4, 4)
    np.testing.assert_allclose(world_T_rigs[:, KNOTS // 2], TRUTH.world_T_rigs, atol=1e-12)
    moves = inverse(world_T_rigs[:, 0]) @ world_T_rigs[:, -1]
    speeds = np.linalg.norm(moves[:, :3, 3], axis=1) / 0.012
    assert speeds.min() > 1.0 and speeds.max() < 1.8  # 1.3 along the path, and steps
    turns = Rotation.from_matrix(moves[:, :3, :3]).as_rotvec(degrees=True)
    assert 0.05 < np.sqrt(np.mean(turns**2)) < 0.2
    assert np.abs(turns.mean(axis=0)).max() < 0.05  # to and fro
    np.testing.assert_array_equal(world_T_rigs, poses_during(TRUTH, 0.012, 0))
    assert not np.allclose(world_T_rigs, poses_during(TRUTH, 0.012, 1), atol=1e-5)


def test_a_camera_of_two_lenses_walks_the_same_way(walk, tmp_path):
    assert walk.lenses is None
    two, again = (
        make_walk(tmp_path / name, num_frames=FRAMES, width=WIDTH, seed=3, camera="two-lens")
        for name in ("two", "again")
    )
    assert two.lenses == TwoLenses()
    for ours, ideal in ((two.truth_path, walk.truth_path), (two.slam_path, walk.slam_path)):
        assert ours.read_bytes() == ideal.read_bytes()
    known = json.loads((two.truth_path.parent / "calibration.json").read_text())
    front, back = (np.array(known["lenses"][name]["rig_T_lens"]) for name in ("front", "back"))
    assert front[2, 3] - back[2, 3] == pytest.approx(TwoLenses().baseline)
    for lens, ahead in ((front, 1), (back, -1)):
        np.testing.assert_allclose(lens[:3, 1:3].T, [[*SWEEP, 0], [0, 0, ahead]])
        assert np.linalg.det(lens) == pytest.approx(1)
    name = "000002.jpg"
    assert (two.frames_dir / name).read_bytes() == (again.frames_dir / name).read_bytes()
    images = [cv2.imread(str(each.frames_dir / name)) for each in (walk, two)]
    ideal, ours = (cv2.blur(np.asarray(image), (9, 9)).astype(float) for image in images)
    ratio, ahead = (ours + 1).mean(axis=2) / (ideal + 1).mean(axis=2), _ahead(WIDTH)
    assert np.median(ratio[ahead > 10]) == pytest.approx(1.03, abs=0.01)
    assert np.median(ratio[ahead < -10]) == pytest.approx(0.97, abs=0.01)


@pytest.mark.slow
def test_demo_compares_one_centre_with_two_lenses(tmp_path):
    few = ["--frames", "3", "--width", "256", "--out", str(tmp_path / "demo")]
    result = succeed("-q", "demo", "--camera", "two-lens", *few)
    starts = [line[:12].strip() for line in result.stdout.splitlines()]
    assert starts[2:5] == ["before", "one centre", "two lenses"]
    assert "Two lenses were not found: too few points" in result.stdout  # of three frames
    for run in ("run", "run-central"):
        assert (tmp_path / "demo" / run / "trajectory.tum").is_file()
    wrong = run_gsba("demo", "--camera", "nonsense", "--out", tmp_path / "x")
    assert wrong.exit_code == 1
    assert wrong.stderr == "error: camera 'nonsense' is none of ideal, two-lens\n"
    assert [p.name for p in tmp_path.iterdir()] == ["demo"]


def test_demo_says_what_was_found_beside_what_is_true():
    found = {"taken": True, "baseline": 0.016, "baseline_sigma": 1e-4}
    still = found | {"readout": {"taken": False, "reason": "all stood still"}}
    assert _found_lenses(still, 2.0, TwoLenses()) == (
        "Found: lenses 32.00 mm apart (sigma 0.20; true 32), no rolling shutter: all stood still."
    )
    read = found | {"readout": {"taken": True, "ms": 12.3, "ms_sigma": 0.2}}
    line = _found_lenses(read, 2.0, TwoLenses())
    assert line.endswith("true 32), rows read in 12.30 ms (sigma 0.20; true 12).")


@pytest.mark.slow
def test_demo_ends_like_refine_where_its_walk_falls_apart(tmp_path, monkeypatch):
    refine = pipeline.refine

    def refine_in_parts(*arguments, **options):
        """A run of which one frame in three is in no map."""
        result = refine(*arguments, **options)
        whole = replace(result.reconstruction, components=np.array([0, 0, 1], np.int32))
        maps = summarize_maps(whole, result.frames)
        changed = {"frames_in_no_map": 1, "refined": 2, "exported": 2}
        summary = result.report["summary"] | changed
        return replace(result, maps=maps, report=result.report | {"summary": summary})

    few = ["-q", "demo", "--frames", "3", "--width", "256", "--out", str(tmp_path / "demo")]
    assert run_gsba(*few).exit_code == 0
    monkeypatch.setattr(pipeline, "refine", refine_in_parts)
    result = run_gsba(*few)
    assert result.exit_code == 3 and "2 of 3 frames refined (1 in no map)" in result.stdout
    assert result.stderr.splitlines()[-1].endswith("exit code 3; --allow-partial makes it 0")
    assert run_gsba(*few, "--allow-partial").exit_code == 0
