"""Worlds turned upright, scaled and placed: exact where data are, robust where some are wrong."""

import dataclasses
import json
from pathlib import Path

import cv2
import export_scene as scene
import numpy as np
import pytest
from command import fails, run_gsba
from plain_records import frames_of
from refusals import refused
from scipy.spatial.transform import Rotation
from walk_on_earth import ORIGIN, frame_set, geodetic_of, level_metres, walk_result, write_fixes

from gsba.camera.sphere import erp_directions
from gsba.config import PlacementSettings
from gsba.export import ExportFormat, export
from gsba.frames.recordings import combine
from gsba.geometry import angular_errors, pose
from gsba.log import GsbaError
from gsba.placement import gravity
from gsba.placement.gps import local_from_geodetic, read_gps
from gsba.placement.placement import Placement, place
from gsba.similarity import Sim3, level_similarity, residuals_of, robust_similarity, similarity
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FrameSet, PictureFormat, PoseStatus, Trajectory


def test_local_metres_of_known_places() -> None:
    """A degree of latitude at the equator and at the pole, of longitude at the equator."""
    equator, pole = np.zeros(3), np.array([89.9999, 0, 0])
    east = local_from_geodetic(np.array([[0, 0.001, 0]]), equator)[0]
    np.testing.assert_allclose(east, [111.319491, 0, -0.000971], atol=1e-5)
    north = local_from_geodetic(np.array([[0.001, 0, 0]]), equator)[0]
    np.testing.assert_allclose(north[1], 110.574276, atol=1e-5)  # radius a (1 - e2)
    high = local_from_geodetic(np.array([[89.9999, 0, 100.0]]), pole)[0]
    np.testing.assert_allclose(high, [0, 0, 100], atol=1e-6)


def test_covariances_and_angles_follow() -> None:
    base = scene.reconstruction()
    cov = np.tile(np.diag([1.0, 2, 3, 4, 5, 6]), (scene.NUM_FRAMES, 1, 1))
    base = dataclasses.replace(base, pose_covariances=cov)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    placement = Placement(Sim3(2.0, turn, np.array([3.0, -2.0, 5.0])))
    moved = placement.apply(base)
    np.testing.assert_allclose(
        np.diagonal(moved.pose_covariances, axis1=1, axis2=2)[0], [1, 2, 3, 16, 20, 24]
    )
    errors = angular_errors(
        moved.world_T_rigs[moved.observation_frames],
        moved.points_world[moved.observation_points],
        moved.observation_bearings,
    )
    assert errors.max() < 1e-9  # the pictures still say the same
    shift = -0.5 * turn.T @ placement.similarity.translation
    back = Placement(Sim3(0.5, turn.T, shift)).apply(moved)
    np.testing.assert_allclose(back.world_T_rigs, base.world_T_rigs, atol=1e-12)
    np.testing.assert_allclose(placement.matrix @ placement.inverse, np.eye(4), atol=1e-12)


def test_every_export_says_what_was_done(tmp_path: Path) -> None:
    base, frames = scene.reconstruction(), scene.panoramas(tmp_path / "frames")
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    placement = Placement(Sim3(3.0, turn, np.array([1.0, 2, 3])), unit="m", up="z")
    export(base, frames, tmp_path / "tum", ExportFormat.TUM, placement=placement)
    placed = read_trajectory(tmp_path / "tum/trajectory.tum").world_T_rigs
    said = json.loads((tmp_path / "tum/transform.json").read_text())
    assert (said["scale"], said["unit"], said["up"]) == (3.0, "m", "z")
    for matrix, source, target in (
        (said["matrix"], base.world_T_rigs, placed),
        (said["inverse"], placed, base.world_T_rigs),
    ):
        homogeneous = np.column_stack([source[:, :3, 3], np.ones(len(source))])
        carried = homogeneous @ np.array(matrix).T
        np.testing.assert_allclose(carried[:, :3], target[:, :3, 3], atol=1e-12)
    export(base, frames, tmp_path / "ns", ExportFormat.NERFSTUDIO, placement=placement)
    document = json.loads((tmp_path / "ns/transforms.json").read_text())
    np.testing.assert_array_equal(np.array(document["applied_transform"])[:, :3], np.eye(3))
    front = np.array(document["frames"][0]["transform_matrix"])
    np.testing.assert_allclose(front[:3, 3], placed[0, :3, 3], atol=1e-9)
    export(base, frames, tmp_path / "plain", ExportFormat.TUM)
    said = json.loads((tmp_path / "plain/transform.json").read_text())
    np.testing.assert_array_equal(said["matrix"], np.eye(4))
    assert said["unit"] == "map units"


def test_scale_between_frames_or_points() -> None:
    result, frames = walk_result(), frame_set(40)
    true = float(np.linalg.norm(level_metres(result)[30] - level_metres(result)[2]))
    settings = PlacementSettings(length=true, between=("frame_0002", "frame_0030"))
    placed = place(result, frames, settings)
    assert placed.unit == "m" and placed.similarity.scale == pytest.approx(1 / 0.21, rel=1e-12)
    placed = place(result, frames, PlacementSettings(length=5.0, between=("0,0,0", "0,0.5,0")))
    assert placed.similarity.scale == pytest.approx(10)


def test_a_length_that_is_wrong_by_ten_is_told_by_the_lenses(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frames = frame_set(40)
    result = dataclasses.replace(walk_result(), lens_baseline=(0.032 * 0.21, 0.0003))
    ends = level_metres(walk_result())[[2, 30]]
    true = float(np.linalg.norm(ends[1] - ends[0]))
    for wrong in (1.0, 10.0):
        settings = PlacementSettings(length=wrong * true, between=("frame_0002", "frame_0030"))
        placed = place(result, frames, settings, (0.032, 0.001))
        assert placed.similarity.scale == pytest.approx(wrong / 0.21)
        told = "but the distance between its lenses gives 4.762" in caplog.text
        assert told == (wrong > 1)


def test_lengths_are_between_refined_frames() -> None:
    result = walk_result()
    result.pose_statuses[30] = PoseStatus.UNREFINED
    settings = PlacementSettings(length=2.0, between=("frame_0002", "frame_0030"))
    refused("frame_0030: its pose was not refined", place, result, frame_set(40), settings)


def test_scale_by_the_distance_between_lenses() -> None:
    asked, frames = PlacementSettings(length="lens"), frame_set(40)
    result = dataclasses.replace(walk_result(), lens_baseline=(0.01, 0.0004))
    placed = place(result, frames, asked, (0.032, 0.00096))
    assert placed.unit == "m" and placed.similarity.scale == pytest.approx(3.2)
    assert placed.grounds["lens"]["scale_sigma"] == pytest.approx(0.05 * 3.2)  # 4 and 3 percent
    assert placed.apply(result).lens_baseline == pytest.approx((0.032, 0.00128))
    wrong = {
        "found no two lenses": (walk_result(), (0.032, 0.001)),
        "needs the distance between the lenses": (result, None),
        "none has a known distance": (
            dataclasses.replace(result, lens_baseline=(0.01, np.inf)),
            (0.032, 0.001),
        ),
        "a sigma of 20 %; less than 10 % is needed": (
            dataclasses.replace(result, lens_baseline=(0.01, 0.002)),
            (0.032, 0.0),
        ),
    }
    for message, (given, baseline) in wrong.items():
        refused(message, place, given, frames, asked, baseline)


@pytest.mark.parametrize("share", [0.0, 0.2])
@pytest.mark.parametrize("named", [False, True])
def test_gps_is_exact_and_robust(tmp_path: Path, share: float, named: bool) -> None:
    result, frames = walk_result(), frame_set(40)
    local = level_metres(result)
    fixes = geodetic_of(local + np.array([200.0, -100.0, 30.0]))
    wrong = np.random.default_rng(4).choice(40, round(40 * share), replace=False)
    fixes[wrong] += np.random.default_rng(5).normal(0, [1e-3, 1e-3, 60], (len(wrong), 3))
    if named:
        path = tmp_path / "gps.csv"
        rows = [
            f"{name}.jpg,{lat:.12f},{lon:.12f},{alt:.6f}"
            for name, (lat, lon, alt) in zip(frames.names, fixes, strict=True)
        ]
        path.write_text("\n".join(["name,latitude,longitude,altitude", *rows]))
    else:
        path = write_fixes(tmp_path / "gps.csv", frames.timestamps, fixes)
    placed = place(result, frames, PlacementSettings(gps=str(path)))
    assert placed.similarity.scale == pytest.approx(1 / 0.21, rel=1e-6)
    assert (placed.unit, placed.up) == ("m", "z") and placed.origin is not None
    assert placed.grounds["gps"]["outliers"] == len(wrong)
    positions = placed.apply(result).world_T_rigs[:, :3, 3]
    right = np.setdiff1d(np.arange(40), wrong)
    expected = local_from_geodetic(fixes[right], np.array(placed.origin))
    np.testing.assert_allclose(positions[right], expected, atol=1e-4)
    assert np.abs(positions).max() < 1000  # small numbers: the place on earth is kept apart


def test_gps_noise_averages_out(tmp_path: Path) -> None:
    result, frames = walk_result(), frame_set(40)
    noisy = level_metres(result) + np.random.default_rng(6).normal(0, 0.5, (40, 3))
    path = write_fixes(tmp_path / "gps.csv", frames.timestamps, geodetic_of(noisy))
    placed = place(result, frames, PlacementSettings(gps=str(path)))
    assert placed.similarity.scale == pytest.approx(1 / 0.21, rel=0.02)
    assert placed.grounds["gps"]["rmse_m"] == pytest.approx(0.5 * np.sqrt(3), rel=0.25)


def test_gpx_tracks_are_unix_time(tmp_path: Path) -> None:
    points = "".join(
        f'<trkpt lat="{48 + i * 1e-5}" lon="11"><ele>5{i}</ele>'
        f"<time>2024-05-01T10:00:0{i}Z</time></trkpt>"
        for i in range(3)
    )
    path = tmp_path / "t.gpx"
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    path.write_text(
        f'<?xml version="1.0"?>\n<gpx {space}><trk><trkseg>{points}</trkseg></trk></gpx>'
    )
    fixes = read_gps(path)
    np.testing.assert_array_equal(fixes.timestamps, [1714557600, 1714557601, 1714557602])
    np.testing.assert_allclose(fixes.geodetic[2], [48.00002, 11, 52])


def test_heading_and_scale_with_gravity_known() -> None:
    rng = np.random.default_rng(7)
    source = rng.normal(size=(30, 3)) * [5, 1e-4, 0.5]
    turn = Rotation.from_rotvec([0, 0, 2.2]).as_matrix()
    target = 4.0 * source @ turn.T + [7, 8, 9]
    target[:6] += rng.normal(0, 30, (6, 3))
    fit, used = robust_similarity(source, target, level_similarity, 2, np.zeros(30), 0.05)
    assert np.sqrt(np.mean(residuals_of(fit, source, target)[used] ** 2)) < 1e-9
    assert fit.scale == pytest.approx(4) and not used[:6].any() and used[6:].all()
    np.testing.assert_allclose(fit.rotation, turn, atol=1e-9)
    np.testing.assert_allclose(fit.translation, [7, 8, 9], atol=1e-8)


def test_robust_similarity_without_outliers_is_least_squares() -> None:
    rng = np.random.default_rng(8)
    source = rng.normal(size=(50, 3))
    target = 2 * source + rng.normal(0, 0.1, (50, 3))
    fit, used = robust_similarity(source, target, similarity, 3, np.full(50, 1.0), 0.0)
    assert used.all()
    np.testing.assert_allclose(fit.rotation, similarity(source, target).rotation, atol=1e-12)


def test_truth_with_large_coordinates(tmp_path: Path) -> None:
    result, frames = walk_result(), frame_set(40)
    far = np.array([691_234.5, 5_334_567.25, 540.0])
    true = Placement(Sim3(1 / 0.21, translation=far)).apply(result).world_T_rigs
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps + 0.004, true))
    placed = place(result, frames, PlacementSettings(align=str(tmp_path / "truth.tum")))
    assert np.abs(placed.similarity.translation).max() < 200 and placed.offset[1] == 5_334_600
    positions = placed.similarity.points(result.world_T_rigs[:, :3, 3]) + placed.offset
    np.testing.assert_allclose(positions, true[:, :3, 3], atol=1e-6)


def test_truth_of_a_straight_walk_takes_the_roll_from_orientations(tmp_path: Path) -> None:
    result, frames = walk_result(straight=True), frame_set(40)
    turn = Rotation.from_rotvec([1.0, 0.3, -0.4]).as_matrix()
    true = Placement(Sim3(7.0, turn, np.ones(3))).apply(result).world_T_rigs
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps, true))
    placed = place(result, frames, PlacementSettings(align=str(tmp_path / "truth.tum")))
    np.testing.assert_allclose(placed.apply(result).world_T_rigs, true, atol=1e-9)


def test_mirrored_truth_is_refused(tmp_path: Path) -> None:
    result, frames = walk_result(), frame_set(40)
    true = Placement(Sim3(1 / 0.21)).apply(result).world_T_rigs
    true[:, :3, 3] *= [1, 1, -1]
    write_tum(tmp_path / "truth.tum", Trajectory(frames.timestamps, true))
    settings = PlacementSettings(align=str(tmp_path / "truth.tum"))
    refused("a mirror image of its positions fits", place, result, frames, settings)


@pytest.mark.parametrize("up", ["none", "auto"])
def test_a_stuck_receiver_is_refused(
    tmp_path: Path, up: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    upright = Placement(up="-y")
    monkeypatch.setattr("gsba.placement.placement._upright", lambda *_: upright)
    result, frames = walk_result(), frame_set(40)
    path = write_fixes(tmp_path / "gps.csv", frames.timestamps, np.tile(ORIGIN, (40, 1)))
    settings = PlacementSettings(gps=str(path), up=up)  # type: ignore[arg-type]
    message = "all 40 positions are equal: the receiver repeated one fix"
    refused(message, place, result, frames, settings)
    rng = np.random.default_rng(11)
    path = write_fixes(path, frames.timestamps, geodetic_of(rng.normal(0, 2, (40, 3))))
    message = r"gps.csv: its positions and the frames' are not correlated"
    refused(message, place, result, frames, settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"length": 1e-320, "between": ("0,0,0", "1,0,0")}, "a scale of 9.99989e-321"),
        ({"length": 1e300, "between": ("0,0,0", "1,0,0")}, "a scale of 1e"),
        ({"length": 1.0, "between": ("1e200,0,0", "0,0,0")}, "is neither a frame"),
        (
            {"length": 1.0, "between": ("9" * 5000, "0,0,0")},
            r"--between 999+\.\.\.9+: this is neither",
        ),
    ],
)
def test_extreme_placements_are_refused(settings: dict, message: str) -> None:
    refused(message, place, walk_result(), frame_set(40), PlacementSettings(**settings))


def test_times_that_are_only_an_order_place_nothing(tmp_path: Path) -> None:
    result, frames = walk_result(), dataclasses.replace(frame_set(40), timed=False)
    write_tum(tmp_path / "t.tum", Trajectory(frames.timestamps, result.world_T_rigs))
    settings = PlacementSettings(align=str(tmp_path / "t.tum"))
    refused("the frames have no times", place, result, frames, settings)
    path = write_fixes(tmp_path / "gps.csv", frames.timestamps, geodetic_of(level_metres(result)))
    settings = PlacementSettings(gps=str(path))
    refused("the frames have no times", place, result, frames, settings)


def _posts(folder: Path, tilt: np.ndarray, num: int = 6) -> tuple[FrameSet, np.ndarray]:
    """Panoramas of a room of vertical posts, and the rotations world_R_rig they were taken with."""
    rng = np.random.default_rng(9)
    width, height = 1024, 512
    rays = erp_directions(width)
    edges = np.sort(rng.uniform(-np.pi, np.pi, 36))
    shades = rng.uniform(40, 220, len(edges))
    folder.mkdir()
    rotations, paths = [], []
    for f in range(num):
        sway = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        world_R_rig = Rotation.from_rotvec([0, rng.uniform(-3, 3), 0]).as_matrix() @ tilt @ sway
        rotations.append(world_R_rig)
        world = rays @ world_R_rig.T  # y down: posts are lines of equal longitude
        longitude = np.arctan2(world[..., 0], world[..., 2])
        image = shades[np.searchsorted(edges, longitude) % len(edges)].astype(np.float32)
        paths.append((folder / f"{f}.png",))
        cv2.imwrite(str(paths[-1][0]), cv2.GaussianBlur(image, (0, 0), 1.0))
    return frames_of(PictureFormat("erp", width, height), paths), np.array(rotations)


@pytest.mark.parametrize("tilt_deg", [0.0, 5.0])
def test_vertical_edges_make_up_exact(tmp_path: Path, tilt_deg: float) -> None:
    """A stick held askew, always to the same side, is what rigs' axes cannot tell from up."""
    tilt = Rotation.from_rotvec([np.deg2rad(tilt_deg), 0, 0]).as_matrix()
    frames, rotations = _posts(tmp_path / "frames", tilt)
    turn = Rotation.from_rotvec([0.5, 1.0, -0.4]).as_matrix()
    result = walk_result(len(frames))
    result = dataclasses.replace(result, world_T_rigs=pose(turn @ rotations, np.zeros((6, 3))))
    found = gravity.estimate_gravity(result, frames)
    assert found is not None and found.num_edges >= 40
    error = np.degrees(np.arccos(np.clip(found.up @ turn @ [0, -1, 0], -1, 1)))
    assert error < 0.2  # edges drawn to a fraction of a pixel of 0.35 degrees
    placed = place(result, frames, PlacementSettings(up="auto"))
    np.testing.assert_allclose(placed.similarity.rotation @ found.up, [0, -1, 0], atol=1e-12)
    assert placed.up == "-y" and placed.similarity.scale == 1.0


def test_without_edges_the_rigs_decide(tmp_path: Path) -> None:
    frames = scene.panoramas(tmp_path / "frames")  # soft blobs, nothing straight
    found = gravity.estimate_gravity(scene.reconstruction(), frames)
    assert found is not None and found.num_edges == 0
    np.testing.assert_array_equal(found.up, found.by_rigs)
    tumbling = scene.reconstruction()
    poses = tumbling.world_T_rigs.copy()
    poses[:, :3, :3] = Rotation.random(len(poses), random_state=1).as_matrix()
    with pytest.raises(GsbaError, match="have no common up axis"):
        settings = PlacementSettings(up="auto")
        place(dataclasses.replace(tumbling, world_T_rigs=poses), frames, settings)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no positions"),
        ("name,lat\n", "has no columns of latitude and longitude"),
        ("lat,lon\n1,2\n", "has no column of frames' names or times"),
        ("time,lat,lon\n1,2\n", "gps.csv:2: the line has 2 cells, the header 3"),
        ("time,lat,lon\n1,north,3\n", "latitude 'north' is not a number"),
        ("time,lat,lon\n1,95,3\n", "are out of range"),
        ("time,lat,lon\n1,5,3\n1,5,4\n", "two positions at one time"),
        ("name,lat,lon\na,5,3\nb,5,4\na.jpg,6,4\n", "of frame 'a': positions 1 and 3; remove one"),
        ("time,lat,lon\n900,5,3\n901,5,4\n", "no overlap in time"),
        ("name,lat,lon\nelsewhere,5,3\n", "0 of its positions are of refined frames"),
        ("$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47", "is an NMEA log;"),
        ("time;lat;lon\n1;5,1;3,2\n", "has semicolons between its columns; use commas, and points"),
        ("<gpx><trk/></gpx>", "holds no track points"),
        ("<kml xmlns='http://www.opengis.net/kml/2.2'/>", "is KML, whose points have no times"),
        ("<gpx><trk>", "neither a CSV table nor a GPX track"),
        ("<gpx><trkpt lat='1' lon='2'/></gpx>", "has no time"),
        ('<?xml version="1.0" encoding="utf-32"?><gpx/>', "neither a CSV table nor a GPX track"),
        ('<?xml version="1.0" encoding="x-none"?><gpx/>', "neither a CSV table nor a GPX track"),
        ("name,lat,lon,alt\na,1,2,1e300", r"gps.csv:2: altitude 1e\+300 is out of range"),
        ("name,lat,lon\n" + "a" * 140_000 + ",1,2", "gps.csv:2: not a row of a CSV table"),
        ("time,lat,lon\n" + "9" * 5000 + ",1,2", r"gps.csv:2: time '9+\.\.\.9+' is not a number"),
    ],
)
def test_bad_gps_files(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "gps.csv").write_text(content)
    settings = PlacementSettings(gps=str(tmp_path / "gps.csv"))
    refused(message, place, walk_result(), frame_set(40), settings)


def test_positions_on_a_line_leave_a_roll_open(tmp_path: Path) -> None:
    result, frames = walk_result(straight=True), frame_set(40)
    path = write_fixes(tmp_path / "gps.csv", frames.timestamps, geodetic_of(level_metres(result)))
    with pytest.raises(GsbaError, match="determines no roll: add --up auto"):
        place(result, frames, PlacementSettings(gps=str(path)))


def test_bad_options(tmp_path: Path) -> None:
    result, frames = walk_result(), frame_set(40)
    truth = tmp_path / "t.tum"
    write_tum(truth, Trajectory(frames.timestamps + 100, result.world_T_rigs))
    for settings, message in (
        (PlacementSettings(length=2.0), "need each other"),
        (PlacementSettings(length=2.0, between=("a", "b"), gps="g"), "pass one"),
        (PlacementSettings(up="auto", align=str(truth)), "leave out --up auto"),
        (PlacementSettings(align=str(truth)), "0 of its poses are within"),
        (PlacementSettings(length=2.0, between=("nobody", "0,0,0")), "--between nobody"),
        (PlacementSettings(length=2.0, between=("0,0,0", "0,0,0")), "both ends are at one point"),
    ):
        refused(message, place, result, frames, settings)
    for options, message in (
        (("--up", "down"), 'placement.up = "down" is not allowed: use one of "auto", "none"'),
        (("--scale", -1, "--between", "a", "b"), "placement.length = -1.0"),
    ):
        fails(run_gsba("export", tmp_path, "--to", "tum", *options), message)


@pytest.mark.parametrize("true", [True, False])
def test_tags_of_attitude_make_up_where_they_agree_with_poses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, true: bool
) -> None:
    """A camera held at all angles; its maker counts roll the other way round."""
    frames, level = scene.panoramas(tmp_path / "frames"), scene.reconstruction()
    num, rng = len(frames), np.random.default_rng(4)
    yaws, pitches, rolls = rng.uniform(-1, 1, (3, num)) * [[180], [60], [50]]
    turns = Rotation.from_euler("YXZ", np.column_stack([yaws, pitches, rolls]), degrees=True)
    world = Rotation.from_rotvec([0.5, 0.2, -0.4])
    poses = pose((world * turns).as_matrix(), level.world_T_rigs[:, :3, 3])
    tags = np.column_stack([pitches, -rolls]) + rng.normal(0, 0.5, (num, 2))
    shown = tags if true else rng.permutation(tags)
    monkeypatch.setattr(gravity, "_tilt_deg", lambda _, f: tuple(shown[f]))
    found = gravity.estimate_gravity(dataclasses.replace(level, world_T_rigs=poses), frames)
    if not true:
        assert found is None
        return
    error = np.degrees(np.arccos(np.clip(found.by_tags @ world.apply([0, -1, 0]), -1, 1)))
    assert error < 0.5


@pytest.mark.parametrize("named", [False, True])
def test_positions_of_the_first_recording_place_no_map_of_another(
    tmp_path: Path, named: bool
) -> None:
    """A map without the first recording: its own positions are named after it, or later."""
    result, frames = walk_result(), frame_set(40)
    both = combine({name: _elsewhere(frames, tmp_path / name) for name in ("one", "two")})
    second = both.taken(both.recordings["two"])
    fixes = geodetic_of(level_metres(result))
    path = write_fixes(tmp_path / "gps.csv", frames.timestamps, fixes)
    if named:
        rows = zip(frames.names, fixes.tolist(), strict=True)
        lines = [",".join([f"{name}.jpg", *map(repr, fix)]) for name, fix in rows]
        path.write_text("\n".join(["name,lat,lon,alt", *lines]))
    settings = PlacementSettings(gps=str(path))
    first = both.taken(both.recordings["one"])
    placed = place(result, first, settings, whole=both)
    assert placed.similarity.scale == pytest.approx(1 / 0.21, rel=1e-6)
    with pytest.raises(GsbaError, match="0 of its positions are of refined frames"):
        place(result, second, settings, whole=both)


def test_true_poses_of_several_recordings_are_on_one_clock(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """True poses on the clock of a recording that begins .5 s late are a frame off: a warning."""
    result, alone = walk_result(), frame_set(40)
    late = dataclasses.replace(alone, timestamps=alone.timestamps + 0.5)
    both = combine({name: _elsewhere(late, tmp_path / name) for name in ("one", "two")})
    write_tum(tmp_path / "t.tum", Trajectory(late.timestamps, result.world_T_rigs))
    settings = PlacementSettings(align=str(tmp_path / "t.tum"))
    place(result, late, settings)
    assert not caplog.records
    placed = place(result, both.taken(both.recordings["one"]), settings)
    assert placed.grounds["align"]["rmse"] > 1e-2
    assert "times are taken for those of the run's trajectory.tum" in caplog.text


def _elsewhere(frames: FrameSet, folder: Path) -> FrameSet:
    """The frames with files of their own."""
    folder.mkdir()
    paths = [folder / path.name for (path,) in frames.paths]
    for path in paths:
        path.write_text(str(path))
    return dataclasses.replace(frames, paths=tuple((path,) for path in paths))
