"""Work shared out among threads: how it is cut, and sums that do not depend on who adds."""

import time

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from synthetic import unit

from factors import BearingTerm, LandmarkBlock, RobustLoss
from factors.threads import balanced_ranges, map_in_threads


def test_runs_cover_all_owners_and_are_balanced() -> None:
    offsets = np.concatenate([[0], np.cumsum(np.random.default_rng(0).integers(2, 30, 20_000))])
    ranges = balanced_ranges(offsets)
    assert len(ranges) > 4
    assert [first for first, _ in ranges] == [0, *(last for _, last in ranges[:-1])]
    assert ranges[-1][1] == len(offsets) - 1
    sizes = [offsets[last] - offsets[first] for first, last in ranges]
    assert max(sizes) < 1.1 * min(sizes)


def test_few_or_no_owners_are_one_run() -> None:
    assert balanced_ranges(np.array([0])) == [(0, 0)]
    assert balanced_ranges(np.array([0, 3, 5])) == [(0, 2)]


def test_results_come_in_order_whoever_is_done_first() -> None:
    def work(i: int) -> int:
        time.sleep(0.02 if i == 0 else 0)
        return i

    assert list(map_in_threads(work, 6, 3)) == list(range(6))


def test_sums_over_landmarks_are_the_same_to_the_last_bit() -> None:
    num_frames, num_points, seen = 12, 8_000, 6
    rng = np.random.default_rng(0)
    points = rng.normal(0, 5, (num_points, 3))
    owners = np.repeat(np.arange(num_points), seen)
    frames = rng.permuted(np.tile(np.arange(num_frames), (num_points, 1)), axis=1)[:, :seen].ravel()
    bearings = unit(points[owners] + rng.normal(0, 0.02, (len(owners), 3)))
    values, keys = gtsam.Values(), [X(f) for f in range(num_frames)]
    for key in keys:
        values.insert(key, gtsam.Pose3.Expmap(0.1 * rng.normal(size=6)))
    steps = 0.01 * rng.normal(size=(num_frames, 6))

    def results(num_threads: int) -> list[np.ndarray]:
        term = BearingTerm(frames, owners, bearings, np.full(len(owners), 1e-3))
        block = LandmarkBlock(keys, points, [term], RobustLoss("cauchy", 2.0), num_threads)
        system = block.linearize(values)
        cost = block.propose(values, steps)
        block.accept()
        return [
            system.diagonal, system.off_diagonal, system.gradient, block.points_world,
            np.array([cost, block.error(values), *system.costs.values()]),
        ]  # fmt: skip

    assert len(balanced_ranges(np.arange(0, len(owners) + 1, seen))) > 4
    alone = results(1)
    for num_threads in (2, 3, 4):
        for one, other in zip(alone, results(num_threads), strict=True):
            np.testing.assert_array_equal(one, other)
