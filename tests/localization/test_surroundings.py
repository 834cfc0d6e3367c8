"""Evidence of the surroundings at true poses and elsewhere, and the choice among poses."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_run import Case

from gsba import GsbaError, Localizer, refine
from gsba.localization.pose_search import (
    LOOK_ALIKE,
    TWO_PLACES,
    Candidates,
    PlacedPose,
    best_of,
    search_poses,
)
from gsba.localization.run_map import Query
from gsba.localization.surroundings import is_contradicted, is_look_alike
from gsba.loop_closure.join_evidence import JoinEvidence

AISLE = Path(__file__).parents[3] / "shared/data/aisle_loop/images"
TRUE = JoinEvidence(0.9, 0.1, 300, 1.0, 0.1, 0.02)
LOOKS_ALIKE = JoinEvidence(0.25, 0.06, 300, 0.5, 0.15, 0.45)


@pytest.fixture(scope="module")
def localizer(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    return Localizer(case.copy(tmp_path_factory.mktemp("map") / "run"))


def _query(localizer: Localizer, frame: int) -> Query:
    return localizer.query_of(localizer.map.load_features(frame), 0, localizer.map.rig)


def test_frames_show_what_is_around_them_and_not_what_is_elsewhere(localizer: Localizer) -> None:
    poses, usual = localizer.map.result.world_T_rigs, localizer.usual.of_camera(0)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    for frame in (2, 4, 6):
        query = _query(localizer, frame)
        at = localizer.surroundings.evidence(query, poses[frame], usual)
        assert at.confirmed and not is_contradicted(at), str(at)
        away = localizer.surroundings.evidence(query, poses[frame] @ turned, usual)
        assert is_look_alike(away) and is_contradicted(away), str(away)
        later = localizer.surroundings.evidence(query, poses[frame - 2], usual)
        assert is_look_alike(later), str(later)


def test_only_what_a_picture_with_edges_can_show_is_expected(localizer: Localizer) -> None:
    pose, usual = localizer.map.result.world_T_rigs[5], localizer.usual.of_camera(-1)
    query = _query(localizer, 5)
    every = localizer.surroundings.evidence(query, pose, usual)
    ahead = localizer.surroundings.evidence(query, pose, usual, lambda points: points[:, 2] > 0)
    nothing = localizer.surroundings.evidence(query, pose, usual, lambda p: np.zeros(len(p), bool))
    assert 0 < ahead.witnesses < every.witnesses
    assert nothing.witnesses == 0 and is_look_alike(nothing) and not is_contradicted(nothing)


def test_faces_are_as_small_as_they_may_be_while_the_runs_pictures_are_there(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = Localizer(case.copy(tmp_path / "run")).map.rig.size
    monkeypatch.setattr("gsba.localization.localizer._MAX_FACE_PX", own // 2)
    smaller = Localizer(case.copy(tmp_path / "smaller"))
    assert smaller.usual.face_px.tolist() == [own // 2]
    assert smaller.usual.chance[0] != smaller.usual.chance[1]  # photos are looked at more closely

    def gone(*_: object) -> None:
        raise GsbaError("no such picture")

    run = case.copy(tmp_path / "gone")
    with monkeypatch.context() as patch:
        patch.setattr(Localizer, "_extract", gone)
        without = Localizer(run)
    assert without.usual.face_px.tolist() == [own]
    kept = Localizer(run).usual  # is not measured again
    np.testing.assert_array_equal(kept.within, without.usual.within)


def test_poses_are_searched_until_few_candidates_agree() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (200, 3))
    moved = np.eye(4)
    moved[:3, 3] = [2.0, 0, 0]
    bearings = np.where(np.arange(200)[:, None] < 120, points, points - moved[:3, 3])
    bearings[180:] = rng.normal(size=(20, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    candidates = Candidates(np.arange(200), bearings, np.arange(200), points)
    found = search_poses(candidates, np.deg2rad(0.2), 0, 5)
    assert [int(one.inliers.sum()) for one in found] == [120, 60]
    np.testing.assert_allclose(found[1].world_T_rig, moved, atol=1e-6)
    assert len(search_poses(candidates, np.deg2rad(0.2), 0, 1)) == 1


def _placed(x: float, cells: range, evidence: JoinEvidence = TRUE) -> PlacedPose:
    pose = np.eye(4)
    pose[0, 3] = x
    return PlacedPose(pose, 1.0, np.array(cells), evidence)


def test_the_pose_is_chosen_that_explains_significantly_more() -> None:
    best = _placed(0, range(100))
    assert best_of([_placed(1, range(60, 120)), best]) == (1, "")  # 60 cells against 20
    assert best_of([best, _placed(1, range(30, 120))]) == (0, TWO_PLACES)  # 30 against 20
    assert best_of([best, _placed(0.1, range(30, 120))]) == (0, "")  # the same place
    assert best_of([best, _placed(1, range(30, 120), LOOKS_ALIKE)]) == (0, "")


def test_a_pose_without_its_surroundings_is_refused() -> None:
    assert best_of([_placed(0, range(100), LOOKS_ALIKE)]) == (0, LOOK_ALIKE)
    assert best_of([_placed(0, range(100), LOOKS_ALIKE), _placed(1, range(60))]) == (0, LOOK_ALIKE)


@pytest.mark.slow
@pytest.mark.skipif(not AISLE.is_dir(), reason="../shared/data/aisle_loop is not here")
def test_frames_of_other_bays_are_not_found_in_the_bays_that_look_like_theirs(
    tmp_path: Path,
) -> None:
    images = sorted(AISLE.glob("*.jpg")) or sorted(AISLE.glob("*.png"))
    (tmp_path / "frames").mkdir()
    for path in images[:15]:
        (tmp_path / "frames" / path.name).symlink_to(path)
    refine(tmp_path / "frames", None, tmp_path / "run")
    localizer = Localizer(tmp_path / "run")
    # Nine to twelve units away, most of them on the other side of the hall, turned about.
    assert not any(localizer.localize(images[n]).found for n in (19, 28, 31, 35, 37, 42, 48))
    assert localizer.localize(images[7]).found
