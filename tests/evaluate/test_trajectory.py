"""Trajectory errors: against their plain definitions, and invariant where they must be."""

import json

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.evaluate.trajectory import AUC_THRESHOLDS_DEG, area_under_recall, evaluate, format_table
from gsba.geometry import inverse, pose
from gsba.trajectory.association import matched_in_time
from gsba.types import Trajectory


def _truth(num: int = 30, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (num, 3)), axis=0)).as_matrix()
    positions = np.cumsum(rng.normal(0, 1, (num, 3)), axis=0)
    return Trajectory(np.arange(num) * 0.1, pose(rotations, positions))


def _disturbed(truth: Trajectory, seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    world_T_rigs = truth.world_T_rigs.copy()
    world_T_rigs[:, :3, :3] @= Rotation.from_rotvec(
        rng.normal(0, 0.01, (len(world_T_rigs), 3))
    ).as_matrix()
    world_T_rigs[:, :3, 3] += rng.normal(0, 0.05, (len(world_T_rigs), 3))
    return Trajectory(truth.timestamps, world_T_rigs)


def _moved(trajectory: Trajectory, scale: float, seed: int = 2) -> Trajectory:
    """The same trajectory seen from another world, in another scale."""
    rng = np.random.default_rng(seed)
    scaled = trajectory.world_T_rigs.copy()
    scaled[:, :3, 3] *= scale
    world = pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 10, 3))
    return Trajectory(trajectory.timestamps, world @ scaled)


def _reference_auc(estimate: Trajectory, truth: Trajectory) -> dict[float, float]:
    """All pairs one by one, and the curve in the words of the literature."""
    errors = []
    for i in range(len(truth.timestamps)):
        for j in range(i + 1, len(truth.timestamps)):
            e = inverse(estimate.world_T_rigs[i]) @ estimate.world_T_rigs[j]
            t = inverse(truth.world_T_rigs[i]) @ truth.world_T_rigs[j]
            rotation = np.degrees(Rotation.from_matrix(e[:3, :3].T @ t[:3, :3]).magnitude())
            a, b = e[:3, 3], t[:3, 3]
            angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
            errors.append(max(rotation, angle))
    errors = np.array([0.0, *sorted(errors)])
    recall = np.arange(len(errors)) / (len(errors) - 1)
    fine = {}
    for threshold in AUC_THRESHOLDS_DEG:
        last = np.searchsorted(errors, threshold)
        x = np.append(errors[:last], threshold)
        y = np.append(recall[:last], recall[last - 1])
        fine[threshold] = np.sum(np.diff(x) * (y[1:] + y[:-1]) / 2) / threshold
    return fine


def test_the_truth_in_another_world_and_scale_has_no_error():
    truth = _truth()
    errors = evaluate(_moved(truth, 0.3), truth)
    assert errors.scale == pytest.approx(1 / 0.3)
    assert errors.ate.max < 1e-12 * 100  # round-off on coordinates of some ten units
    assert errors.rpe_translation.max < 1e-12 * 100
    assert errors.rotation_deg.max < 1e-10 and errors.rpe_rotation_deg.max < 1e-10
    assert all(area > 1 - 1e-9 for area in errors.auc.values())


def test_errors_do_not_depend_on_the_estimates_world_and_scale():
    truth = _truth()
    estimate = _disturbed(truth)
    here, there = evaluate(estimate, truth), evaluate(_moved(estimate, 7.0), truth)
    assert there.ate.rmse == pytest.approx(here.ate.rmse, rel=1e-9)
    assert there.rotation_deg.rmse == pytest.approx(here.rotation_deg.rmse, rel=1e-9)
    assert there.rpe_translation.rmse == pytest.approx(here.rpe_translation.rmse, rel=1e-9)
    assert there.auc == pytest.approx(here.auc, rel=1e-9)


def test_auc_is_that_of_the_pairs_one_by_one(monkeypatch):
    truth = _truth()
    estimate = _disturbed(truth)
    reference = _reference_auc(estimate, truth)
    assert evaluate(estimate, truth).auc == pytest.approx(reference, rel=1e-9)
    monkeypatch.setattr("gsba.evaluate.trajectory._PAIRS_AT_ONCE", 70)  # several uneven blocks
    assert evaluate(estimate, truth).auc == pytest.approx(reference, rel=1e-9)


def test_area_under_recall_by_hand():
    # Through (0, 0), (1, 1/4), (3, 2/4), then flat to 5: 1/8 + 3/4 + 1 over 5.
    areas = area_under_recall(np.array([3.0, 1.0, 9.0]), 4, (0.5, 5.0))
    assert areas[5.0] == pytest.approx((1 / 8 + 3 / 4 + 1) / 5)
    assert areas[0.5] == 0
    assert area_under_recall(np.zeros(3), 3, (1.0,)) == {1.0: 1.0}


def test_consecutive_errors_are_those_of_their_definition():
    truth = _truth()
    estimate = _disturbed(truth)
    errors = evaluate(estimate, truth)
    lengths, angles = [], []
    for i in range(len(truth.timestamps) - 1):
        e = inverse(estimate.world_T_rigs[i]) @ estimate.world_T_rigs[i + 1]
        t = inverse(truth.world_T_rigs[i]) @ truth.world_T_rigs[i + 1]
        lengths.append(np.linalg.norm(errors.scale * e[:3, 3] - t[:3, 3]))
        angles.append(np.degrees(Rotation.from_matrix(e[:3, :3].T @ t[:3, :3]).magnitude()))
    assert errors.rpe_translation.median == pytest.approx(np.median(lengths))
    assert errors.rpe_rotation_deg.rmse == pytest.approx(np.sqrt(np.mean(np.square(angles))))


def test_a_missing_pose_fails_its_pairs_and_its_steps():
    truth = _truth(10)
    kept = np.arange(10) != 4
    part = Trajectory(truth.timestamps[kept], truth.world_T_rigs[kept])
    errors = evaluate(part, truth)
    assert (errors.num_truth, errors.num_matched) == (10, 9)
    assert errors.auc[0.1] == pytest.approx(36 / 45, abs=1e-9)  # 9 choose 2 of 10 choose 2
    lost = truth.world_T_rigs.copy()
    lost[4] = np.nan
    assert evaluate(Trajectory(truth.timestamps, lost), truth) == errors


def test_a_step_over_a_missing_pose_is_no_step():
    truth = _truth(10)
    kinked = truth.world_T_rigs.copy()  # rigid halves, one kink between poses 3 and 5
    kinked[:4] = (
        pose(Rotation.from_euler("x", 20, degrees=True).as_matrix(), np.ones(3)) @ kinked[:4]
    )
    kept = np.arange(10) != 4
    gap = evaluate(Trajectory(truth.timestamps[kept], kinked[kept]), truth)
    assert gap.rpe_rotation_deg.max < 1e-9
    whole = evaluate(Trajectory(truth.timestamps, kinked), truth)
    assert whole.rpe_rotation_deg.max == pytest.approx(20)


def test_without_true_baseline_only_rotation_counts():
    truth = _truth(6)
    truth.world_T_rigs[3, :3, 3] = truth.world_T_rigs[2, :3, 3]
    estimate = Trajectory(truth.timestamps, truth.world_T_rigs.copy())
    estimate.world_T_rigs[3, :3, 3] += 1e-9  # whatever direction this has
    assert evaluate(estimate, truth).auc[10.0] > 1 - 1e-6
    still = Trajectory(truth.timestamps, truth.world_T_rigs.copy())
    still.world_T_rigs[1, :3, 3] = still.world_T_rigs[0, :3, 3]  # this pair did move
    assert evaluate(still, truth).auc[10.0] < 1 - 1 / 15 + 1e-6


def test_rotations_of_half_a_turn_are_measured():
    truth = _truth(5)
    estimate = Trajectory(truth.timestamps, truth.world_T_rigs.copy())
    estimate.world_T_rigs[2, :3, :3] @= np.diag([1.0, -1.0, -1.0])
    assert evaluate(estimate, truth).rotation_deg.max == pytest.approx(180, abs=1e-5)


def test_association_is_mutual_and_within_tolerance():
    eye = np.tile(np.eye(4), (6, 1, 1))
    truth = Trajectory(np.array([0.0, 1.0, 2.0, 3.0]), eye[:4])
    estimate = Trajectory(np.array([0.004, 0.996, 0.999, 2.02, 3.0, 9.0]), eye)
    rows_e, rows_t = matched_in_time(estimate, truth, 0.01)
    assert rows_e.tolist() == [0, 2, 4] and rows_t.tolist() == [0, 1, 3]


@pytest.mark.parametrize("kept", [0, 1, 2])
def test_fewer_than_three_poses_cannot_be_aligned(kept):
    truth = _truth(5)
    part = Trajectory(truth.timestamps[:kept], truth.world_T_rigs[:kept])
    refused(f"only {kept} of 5", evaluate, part, truth)


def test_a_trajectory_that_does_not_move_is_refused():
    truth = _truth(5)
    still = truth.world_T_rigs.copy()
    still[:, :3, 3] = 4.2
    refused("estimate does not move", evaluate, Trajectory(truth.timestamps, still), truth)


def test_a_straight_path_is_aligned_without_inventing_rotation():
    truth = _truth(8)
    truth.world_T_rigs[:, :3, 3] = np.arange(8)[:, None] * [1.0, 0, 0]
    errors = evaluate(_moved(truth, 2.0), truth)
    assert errors.ate.max < 1e-10 and errors.rotation_deg.max < 1e-10


def test_json_and_table_state_what_they_hold():
    truth = _truth()
    rows = {"slam": evaluate(_disturbed(truth), truth), "refined": evaluate(truth, truth)}
    written = json.loads(json.dumps(rows["slam"].to_json(), allow_nan=False))
    assert written["auc"]["0.25"] == rows["slam"].auc[0.25]
    assert written["ate"]["rmse"] == rows["slam"].ate.rmse
    table = format_table(rows, {"reproj. px": ["1.25", "0.31"]}).splitlines()
    assert table[0].split()[:3] == ["poses", "ATE", "rmse"] and "reproj. px" in table[0]
    assert table[3].split()[:3] == ["refined", "30/30", "0.0000"] and table[3].endswith("0.31")
