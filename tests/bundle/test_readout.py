"""Motion during the readout: found with its duration and way, believed where it predicts."""

from dataclasses import replace

import numpy as np
import pytest
from lens_world import motion, placed, problem_of, seen_through, solved_under, solved_with, times
from scipy.spatial.transform import Rotation
from synthetic import World, loop_walk

from gsba.bundle import readout
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import LensCentres
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.geometry import pose
from gsba.report.camera_findings import of_camera
from gsba.types import Counts, Fisheye, Keypoints, Solution

FISHEYE = Fisheye(960, 960, 300.0, (480.0, 480.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

LENSES, READOUT_S = Lenses(np.array([0.0, 0.0, 0.05]), band_rad=np.deg2rad(4)), 0.03
SWEEPS = np.array([[-1.0, 0, 0], [0, 1.0, 0]])
TWISTS = motion(loop_walk(24), READOUT_S)


def _found(camera: Lenses, seed: int) -> tuple[CameraEstimate, float]:
    world, shown = seen_through(camera, seed)
    start, moments = Solution.without_points(world.world_T_rigs), times(len(world.world_T_rigs))
    solved, keypoints, tracks = solved_under(world, shown, LENSES, start)
    around, problem = placed(solved, keypoints, tracks), problem_of(world)
    given = keypoints, problem, LENSES, shown.bearings_rig, moments
    found = readout.estimate(ObservedRays(replace(solved, landmarks=around), *given))
    if not found.reason:
        solved, found = solved_with(world, shown, found, solved, problem)
    return found, solved.noise


@pytest.mark.parametrize("seed", range(2))
def test_duration_way_and_each_frames_motion_are_found(seed: int) -> None:
    found, noise = _found(replace(LENSES, row_directions=SWEEPS, readout_motion=TWISTS), seed)
    assert not found.reason and (found.gains > 0).all()
    assert found.lenses.row_directions is not None
    np.testing.assert_allclose(found.lenses.row_directions, SWEEPS)
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.05)
    off = found.lenses.readout_motion - TWISTS
    before = np.sqrt(np.mean(TWISTS**2, axis=0))
    left = np.sqrt(np.mean(off**2, axis=0)) / before
    assert left[:3].max() < 0.4 and left[3:].max() < 0.3
    assert noise < 1.1


def test_how_far_frames_own_motion_is_spread_is_found() -> None:
    found, _ = _found(replace(LENSES, row_directions=SWEEPS, readout_motion=TWISTS), 0)
    own = TWISTS - READOUT_S * readout.velocities(loop_walk(24), times(24))
    assert found.own_sigmas is not None
    np.testing.assert_allclose(found.own_sigmas, np.sqrt(np.mean(own**2, axis=0)), rtol=0.4)


def test_velocities_do_not_span_the_pause_between_recordings() -> None:
    poses, moments = loop_walk(24), times(24)
    first = readout.velocities(poses[:10], moments[:10])
    second = readout.velocities(poses[10:], moments[10:])
    apart = np.concatenate([moments[:10], moments[10:] + 100.0])
    np.testing.assert_allclose(readout.velocities(poses, apart), np.concatenate([first, second]))


def test_velocities_do_not_span_maps() -> None:
    """Maps lie side by side, as far apart as they please: their distance is no motion."""
    poses, moments, maps = loop_walk(24), times(24), np.repeat([0, 1], [10, 14])
    halves = [readout.velocities(poses[maps == n], moments[maps == n]) for n in (0, 1)]
    poses[10:, :3, 3] += [500.0, 0.0, 0.0]
    found = readout.velocities(poses, moments, maps=maps)
    np.testing.assert_allclose(found, np.concatenate(halves), atol=1e-9)


def test_no_duration_is_found_where_no_neighbour_in_time_tells_how_frames_move() -> None:
    """Frames of two maps that take turns."""
    world, shown = seen_through(LENSES, 0)
    start = Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, LENSES, start)
    around, problem = placed(solved, keypoints, tracks), problem_of(world)
    problem = replace(problem, maps=np.arange(len(world.world_T_rigs)) % 2)
    given = keypoints, problem, LENSES, shown.bearings_rig, times(len(world.world_T_rigs))
    found = readout.estimate(ObservedRays(replace(solved, landmarks=around), *given))
    assert found.reason and found.lenses.readout_motion is None


def test_the_duration_is_found_in_two_maps_of_one_recording() -> None:
    sweeping = replace(LENSES, row_directions=SWEEPS, readout_motion=TWISTS)
    world, shown = seen_through(sweeping, 0)
    start, maps = Solution.without_points(world.world_T_rigs), np.repeat([0, 1], 12)
    solved, keypoints, tracks = solved_under(world, shown, LENSES, start)
    around = placed(solved, keypoints, tracks)
    hosts, seen = maps[around.tracks.hosts()], around.tracks
    strangers = maps[seen.frames] != hosts[seen.points]
    own = np.bincount(seen.points[strangers], minlength=seen.num_points) == 0
    poses, points = solved.world_T_rigs.copy(), around.points_world.copy()
    poses[12:, :3, 3] += [500.0, 0.0, 0.0]
    points[hosts == 1] += [500.0, 0.0, 0.0]
    apart = replace(around, points_world=points).of(own)
    torn = replace(solved, world_T_rigs=poses, landmarks=apart)
    problem = replace(problem_of(world), maps=maps)
    rays = ObservedRays(torn, keypoints, problem, LENSES, shown.bearings_rig, times(24))
    found = readout.estimate(rays)
    assert not found.reason and found.readout_s == pytest.approx(READOUT_S, rel=0.2)
    whole = replace(rays, context=replace(problem, maps=None))
    assert readout.estimate(whole).readout_s < 0.1 * READOUT_S


@pytest.mark.parametrize("seed", range(3))
def test_frames_of_one_instant_have_none(seed: int) -> None:
    found, _ = _found(LENSES, seed)
    assert found.reason and found.lenses.readout_motion is None


def test_no_way_is_taken_while_another_explains_as_much() -> None:
    """Points that only the front lens sees do not tell which way the back one is read."""
    sweeping = replace(LENSES, row_directions=SWEEPS, readout_motion=TWISTS)
    world, shown = seen_through(sweeping, 0)
    start = Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, LENSES, start)
    around = placed(solved, keypoints, tracks)
    seen = around.tracks
    behind = shown.bearings_rig[keypoints.rows(seen), 2] < 0
    ahead = around.of(np.bincount(seen.points[behind], minlength=seen.num_points) == 0)
    given = keypoints, problem_of(world), LENSES, shown.bearings_rig, times(24)
    rays = ObservedRays(replace(solved, landmarks=around), *given)
    found = readout.estimate(rays.of(ahead))
    assert found.reason == "rows may be read in other directions as well"
    assert found.lenses.row_directions is None and found.lenses.readout_motion is None
    assert readout.estimate(rays).lenses.row_directions is not None


def test_rows_of_stitched_pictures_are_known_to_three_per_cent() -> None:
    """How many rows lie between two directions hangs on lenses that a panorama does not tell."""
    stitched = CameraEstimate(Lenses(), readout_s=0.012)
    raw = replace(stitched, lenses=Lenses(reference_calibration=(FISHEYE, FISHEYE)))
    assert readout.total_sigma(stitched, 1e-4) == pytest.approx(np.hypot(1e-4, 0.03 * 0.012))
    assert readout.total_sigma(raw, 1e-4) == 1e-4


def test_a_duration_that_vanishes_beside_frames_own_motion_is_dropped() -> None:
    """Seams that optical flow has aligned have shown one of 28 standard deviations."""
    swept = replace(LENSES, row_directions=SWEEPS, readout_motion=0.05 * TWISTS)
    false = CameraEstimate(swept, 0.05 * READOUT_S, 0.002 * READOUT_S)
    world, shown = seen_through(LENSES, 0)
    start = Solution.without_points(world.world_T_rigs)
    _, found = solved_with(world, shown, false, start, problem_of(world))
    assert abs(found.readout_s) < 0.004 * READOUT_S
    kept = readout.without_vanished(found)
    assert kept.reason == readout.VANISHED
    assert kept.lenses.readout_motion is None and kept.lenses.row_directions is None
    true = replace(found, readout_s=0.05 * READOUT_S)
    assert readout.without_vanished(true) is true


PAIR = FISHEYE, replace(FISHEYE, rotation=(0.0, np.pi, 0.0))
RAW = replace(Lenses.of_raw(PAIR), centre=np.array([0.0, 0.0, 0.05]))
DOWN, FEW = np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]), 6
FEW_POSES = loop_walk(24)[:FEW]
FEW_MOTION = TWISTS[:FEW] * np.repeat([3.0, 1.0], 3)  # 0.3 degrees, as of hands


def _of_few(world: World, shown: Keypoints, few_frames: bool = True) -> tuple:
    start = Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, RAW, start)
    around, problem = placed(solved, keypoints, tracks), problem_of(world)
    given = keypoints, problem, RAW, shown.bearings_rig, times(FEW)
    rays = ObservedRays(replace(solved, landmarks=around), *given)
    return solved, problem, readout.estimate(rays, few_frames)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("signs", [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])
def test_few_raw_frames_show_their_own_motion(seed: int, signs: tuple[float, float]) -> None:
    way = DOWN * np.array(signs)[:, None]
    swept = replace(RAW, row_directions=way, readout_motion=FEW_MOTION)
    world, shown = seen_through(swept, seed, FEW_POSES, FEW)
    _, _, untold = _of_few(world, shown, few_frames=False)
    assert untold.reason == "too few points to tell rows apart"
    solved, problem, found = _of_few(world, shown)
    assert not found.reason and (found.gains > 0).all()
    np.testing.assert_allclose(found.lenses.row_directions, way, atol=1e-9)
    solved, found = solved_with(world, shown, found, solved, problem)
    assert readout.without_vanished(found) is found and found.lenses.readout_motion is not None
    assert found.readout_s == pytest.approx(READOUT_S, rel=0.2)
    left = np.sqrt(np.mean((found.lenses.readout_motion - FEW_MOTION)[:, :3] ** 2))
    assert left < 0.4 * np.sqrt(np.mean(FEW_MOTION[:, :3] ** 2))
    assert solved.noise < 1.1


@pytest.mark.parametrize("num", [FEW, 24])
@pytest.mark.parametrize("signs", [(1.0, 1.0), (-1.0, -1.0)])
def test_raw_lenses_are_read_as_settings_say(signs: tuple[float, float], num: int) -> None:
    """They named the way that a lens is read from the bottom up, and were said to be contradicted;
    where they named another, nothing was."""
    way, few = DOWN * np.array(signs)[:, None], num == FEW
    moved = FEW_MOTION if few else TWISTS
    swept = replace(RAW, row_directions=way, readout_motion=moved)
    world, shown = seen_through(swept, 0, loop_walk(24)[:num], num)
    start = Solution.without_points(world.world_T_rigs)
    solved, keypoints, tracks = solved_under(world, shown, RAW, start)
    around, problem = placed(solved, keypoints, tracks), problem_of(world)
    for said in ("+y", "-y"):
        camera = CameraSettings(sweep=(said, said))
        settings = problem.settings.model_copy(update={"camera": camera})
        context = replace(problem, settings=settings, cameras=())
        given = keypoints, context, RAW, shown.bearings_rig, times(num)
        rays = ObservedRays(replace(solved, landmarks=around), *given)
        found = readout.estimate(rays, few)
        if (said == "+y") == (signs[0] > 0):
            assert not found.reason and found.lenses.row_directions is not None
            np.testing.assert_allclose(found.lenses.row_directions, way, atol=1e-9)
        else:
            assert found.reason == "rows are read the other way than camera.sweep says"
            assert found.lenses is RAW


@pytest.mark.parametrize("seed", range(5))
def test_few_raw_frames_of_one_instant_have_no_readout(seed: int) -> None:
    _, _, found = _of_few(*seen_through(RAW, seed, FEW_POSES, FEW))
    assert found.reason == "motion during the readout does not predict unseen points"
    assert found.lenses is RAW


@pytest.mark.parametrize("seed", range(3))
def test_lenses_of_two_instants_are_no_readout(seed: int) -> None:
    """The back lens takes its picture when the rig has moved on: nothing depends on rows."""
    world, shown = seen_through(RAW, seed, FEW_POSES, FEW)
    moves = pose(Rotation.from_rotvec(FEW_MOTION[:, :3]).as_matrix(), FEW_MOTION[:, 3:])
    _, later = seen_through(RAW, seed, FEW_POSES @ moves, FEW)
    back = RAW.facing(shown.bearings_rig, shown.frames()) == 1
    bearings = np.where(back[:, None], later.bearings_rig, shown.bearings_rig)
    _, _, found = _of_few(world, replace(shown, bearings_rig=bearings))
    assert found.reason == readout.TWO_INSTANTS
    assert found.lenses.row_directions is None and found.lenses.readout_motion is None


def test_the_report_warns_of_two_instants() -> None:
    centres = LensCentres(
        LENSES, LENSES.centre, np.eye(3) * 1e-6, np.zeros(4), "", Counts(9, 9, "")
    )
    seen = CameraEstimate(LENSES, reason=readout.TWO_INSTANTS)
    for one, warned in ((seen, True), (replace(seen, reason="too few points"), False)):
        _, notes = of_camera(FoundCamera(centres, readout=one), None, 1.0, CameraSettings(), True)
        assert any(readout.TWO_INSTANTS in note for note in notes) == warned
