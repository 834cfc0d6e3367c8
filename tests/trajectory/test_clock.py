"""Clocks told by how the camera turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, RotationSpline, Slerp

from gsba.demo import degrade
from gsba.geometry import inverse, pose, rotation_angle
from gsba.trajectory import clock, clock_search
from gsba.trajectory.clock import Clock, ClockEstimate
from gsba.trajectory.clock_search import ClockFit
from gsba.trajectory.steps import Steps
from gsba.types import Trajectory

NUM_FRAMES, INTERVAL_S, PER_FRAME = 40, 0.5, 4
TIMES = 3.0 + INTERVAL_S * np.arange(NUM_FRAMES)
SPAN = TIMES[-1] - TIMES[0]


def _walk(turning: bool, seed: int) -> RotationSpline:
    """Rotations of a walk with corners and a swinging hand, or of one that looks one way."""
    rng = np.random.default_rng(seed)
    around = 2 * np.pi * (TIMES - TIMES[0])[:, None] / rng.uniform(3, 8, (1, 3))
    swing = np.radians(2) * np.sin(around + rng.uniform(0, 2 * np.pi, 3))
    corners = TIMES[0] + SPAN * np.array([0.2, 0.45, 0.6, 0.9])
    heading = sum(0.25 * np.pi * np.tanh((TIMES - c) / 0.7) for c in corners)
    turns = Rotation.from_rotvec(np.outer(heading, [0, 1, 0])) * Rotation.from_rotvec(swing)
    return RotationSpline(TIMES, turns if turning else Rotation.identity(NUM_FRAMES))


def _case(
    true: Clock, *, turning: bool = True, seed: int = 0, outliers: float = 0.0
) -> tuple[Steps, Trajectory]:
    """Steps of the images with noise and gaps, and a drifting trajectory on its own clock."""
    rng, spline = np.random.default_rng(seed), _walk(turning, seed)
    at = np.linspace(TIMES[0], TIMES[-1], PER_FRAME * (NUM_FRAMES - 1) + 1)
    positions = np.outer(at, [1.0, 0, 0])
    exact = Trajectory(true.times(at), pose(spline(at).as_matrix(), positions))
    drifting = degrade(exact, seed)
    poses = drifting.world_T_rigs.copy()
    wrong = rng.choice(len(at), round(outliers * len(at)), replace=False)
    turn = Rotation.from_rotvec(np.radians(10) * rng.normal(size=(len(wrong), 3)))
    poses[wrong, :3, :3] = poses[wrong, :3, :3] @ turn.as_matrix()
    world_T_rigs = pose(spline(TIMES).as_matrix(), np.outer(TIMES, [1.0, 0, 0]))
    steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(NUM_FRAMES - 1, 3)))
    steps[:, :3, :3] = steps[:, :3, :3] @ noise.as_matrix()
    verified = rng.random(NUM_FRAMES - 1) > 0.1
    return Steps(steps, verified, verified), Trajectory(drifting.timestamps, poses)


def _estimate(steps: Steps, trajectory: Trajectory, offset: float = 0.0) -> ClockEstimate:
    return clock.estimate_clock(TIMES, steps, trajectory, offset)


def _off(estimate: ClockEstimate, true: Clock) -> float:
    """Largest error of a frame's time in seconds."""
    return float(np.abs(estimate.clock.times(TIMES) - true.times(TIMES)).max())


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("offset", "rate"), [(0.7, 1.01), (-2.3, 0.99), (0.25, 1.0)])
def test_offset_and_rate_are_found(offset: float, rate: float, seed: int) -> None:
    true = Clock(TIMES[0], offset, rate)
    found = _estimate(*_case(true, seed=seed))
    assert found.verdict == "corrected" and "corrected" in found.note
    assert _off(found, true) < 0.02  # a 25th of the frames' interval
    assert abs(found.found.offset - offset) < 4 * found.offset_sigma + 1e-3
    assert found.after_deg < 0.5 * found.before_deg
    assert (found.clock.rate != 1) == (rate != 1)


@pytest.mark.parametrize("seed", range(2))
def test_outliers_do_not_mislead(seed: int) -> None:
    true = Clock(TIMES[0], 1.2, 1.0)
    found = _estimate(*_case(true, seed=seed, outliers=0.05))
    assert found.verdict == "corrected" and _off(found, true) < 0.05


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_a_right_clock_is_left_alone(seed: int, outliers: float) -> None:
    true = Clock(TIMES[0], 0.0, 1.0)
    found = _estimate(*_case(true, seed=seed, outliers=outliers))
    assert found.clock == true and found.verdict == "agrees" and not found.note


def test_a_stated_offset_is_where_the_search_begins() -> None:
    true = Clock(TIMES[0], 101.0, 1.0)
    steps, trajectory = _case(true)
    assert _estimate(steps, trajectory, 101.0).verdict == "agrees"
    assert _off(_estimate(steps, trajectory, 100.0), true) < 0.02


def test_a_straight_walk_tells_no_clock() -> None:
    found = _estimate(*_case(Clock(TIMES[0], 0.7, 1.01), turning=False))
    assert found.verdict == "unclear" and "turns too little" in found.note
    assert found.clock == Clock(TIMES[0], 0.0, 1.0)


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_a_clock_at_another_rate_is_told(rate: float) -> None:
    """A walk straight on: what the hand turns is too little for a clock, not for its rate."""
    rng = np.random.default_rng(0)
    at = np.linspace(TIMES[0], TIMES[-1], 4 * NUM_FRAMES)
    around = 2 * np.pi * (at - TIMES[0])[:, None] / rng.uniform(3, 8, (1, 3))
    spline = RotationSpline(at, Rotation.from_rotvec(np.radians(1) * np.sin(around)))
    true = Clock(TIMES[0], 0.0, rate)
    poses, drifting = (pose(spline(t).as_matrix(), np.outer(t, [1, 0, 0])) for t in (TIMES, at))
    steps = inverse(poses[:-1]) @ poses[1:]
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(len(at), 3)))
    drifting[:, :3, :3] = drifting[:, :3, :3] @ noise.as_matrix()
    every = np.ones(len(steps), bool)
    found, trajectory = Steps(steps, every, every), Trajectory(true.times(at), drifting)
    told = clock.other_rate(TIMES, found, trajectory, _estimate(found, trajectory))
    assert told == (None if rate == 1 else pytest.approx(rate, rel=0.05))


def test_another_recording_tells_no_clock() -> None:
    steps, _ = _case(Clock(TIMES[0], 0.0, 1.0), seed=0)
    _, trajectory = _case(Clock(TIMES[0], 0.0, 1.0), seed=5)
    scrambled = trajectory.world_T_rigs[np.random.default_rng(0).permutation(len(TIMES))]
    found = _estimate(steps, Trajectory(TIMES, scrambled))
    assert found.verdict == "unclear" and found.clock == Clock(TIMES[0], 0.0, 1.0)


def test_a_turn_that_repeats_leaves_several_clocks() -> None:
    """Four corners exactly six seconds apart, seen by a trajectory that starts elsewhere."""
    long = np.arange(-24.0, 48.0, 0.1)
    heading = np.cumsum(np.exp(-(((long % 6.0) - 3.0) ** 2)))
    poses = pose(Rotation.from_rotvec(np.outer(0.08 * heading, [0, 1, 0])).as_matrix(), 0)
    of_frames = np.searchsorted(long, TIMES)
    world_T_rigs = poses[of_frames]
    steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
    known = np.ones(len(steps), bool)
    trajectory = Trajectory(long + 2.5, poses)
    found = clock.estimate_clock(TIMES, Steps(steps, known, known), trajectory, 0.0)
    assert found.verdict == "unclear" and "several clock offsets fit" in found.note


def test_too_few_steps_tell_no_clock() -> None:
    steps, trajectory = _case(Clock(TIMES[0], 0.7, 1.0))
    few = np.zeros(NUM_FRAMES - 1, bool)
    few[:3] = True
    found = _estimate(Steps(steps.f_T_nexts, few, few), trajectory)
    assert found.verdict == "unclear" and "could not be checked" in found.note


def test_times_go_there_and_back() -> None:
    ours = Clock(3.0, 0.7, 1.01)
    trajectory = Trajectory(ours.times(TIMES), np.tile(np.eye(4), (NUM_FRAMES, 1, 1)))
    np.testing.assert_allclose(ours.on_frames(trajectory).timestamps, TIMES, atol=1e-12)
    assert ours.times(np.array([3.0, 4.0])) == pytest.approx([3.7, 4.71])


def test_residuals_are_rotations_between_instants() -> None:
    """Against interpolation by another library, where the trajectory has poses and where not."""
    steps, trajectory = _case(Clock(TIMES[0], 0.0, 1.0))
    every = np.ones(NUM_FRAMES - 1, bool)
    turns = clock_search.merged(TIMES, steps.f_T_nexts[:, :3, :3], every)
    fit = ClockFit(turns, trajectory)
    parameters = np.array([0.4, 1.002])
    found = fit.residuals(parameters)
    at = turns.middle + parameters[0] + parameters[1] * (turns.times - turns.middle)
    inside = at[:, 1] <= trajectory.timestamps[-1]
    slerp = Slerp(trajectory.timestamps, Rotation.from_matrix(trajectory.world_T_rigs[:, :3, :3]))
    first, second = slerp(at[inside, 0]), slerp(at[inside, 1])
    seen = Rotation.from_rotvec(turns.rotvecs[inside])
    expected = (seen.inv() * first.inv() * second).as_rotvec()
    np.testing.assert_allclose(found[inside], expected, atol=1e-12)
    np.testing.assert_allclose(found[~inside], -turns.rotvecs[~inside])
    assert 0 < inside.sum() < len(inside)


def test_short_steps_are_put_together() -> None:
    times = 0.03 * np.arange(100)
    turn = Rotation.from_rotvec([0, 0.01, 0]).as_matrix()
    known = np.ones(99, bool)
    known[50] = False
    turns = clock_search.merged(times, np.tile(turn, (99, 1, 1)), known)
    assert len(turns) < 20 and turns.step >= 0.2
    assert not ((turns.times[:, 0] <= times[50]) & (turns.times[:, 1] >= times[51])).any()
    rates = np.linalg.norm(turns.rotvecs, axis=1) / np.diff(turns.times, axis=1)[:, 0]
    np.testing.assert_allclose(rates, 0.01 / 0.03, rtol=1e-9)
    angles = rotation_angle(Rotation.from_rotvec(turns.rotvecs).as_matrix())
    assert angles.sum() == pytest.approx(98 * 0.01)


@pytest.mark.parametrize("unit", [1e3, 1e9])
def test_the_grid_is_bounded_whatever_the_times_are(
    unit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trajectory in another unit, and steps so short that a fixed reach holds millions."""
    steps, trajectory = _case(Clock(TIMES[0], 0.0, 1.0))
    wide = Trajectory(unit * trajectory.timestamps, trajectory.world_T_rigs)
    turns = clock_search.merged(TIMES, steps.f_T_nexts[:, :3, :3], steps.verified)
    short = clock_search.Turns(turns.times / unit, turns.rotvecs)
    tried: list[int] = []

    def count(self: ClockFit, parameters: np.ndarray, times: np.ndarray, _: np.ndarray) -> float:
        tried.append(len(times))
        return float(len(tried) % 97)

    monkeypatch.setattr(ClockFit, "_rough_cost", count)
    for fit, start in ((ClockFit(turns, wide), 0.0), (ClockFit(short, trajectory), 3.0)):
        tried.clear()
        assert len(list(fit.candidates(np.array([start, 1.0]), 10.0))) == 5
        assert 0 < len(tried) <= 61_000 and max(tried) <= 200_000
