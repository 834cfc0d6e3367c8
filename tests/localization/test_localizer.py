"""New frames of a tiny walk, localised in its finished run."""

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run_gsba, succeed
from one_gallery import gallery
from tiny_run import NUM_FRAMES, WIDTH, Case

from gsba import GsbaError, Localizer
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.localization import LocalizedFrame
from gsba.localization.place_index import index_path
from gsba.similarity import pose_similarity
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

TIMES = (2, 5, 8)  # of new frames, halfway between those of the run


@pytest.fixture(scope="module")
def new(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory]:
    """Folder of frames halfway between those of the walk, and their true poses."""
    folder = tmp_path_factory.mktemp("new")
    walk = walk_poses("open", "locked", 6 * NUM_FRAMES, 0)  # twice as dense as the tiny run
    scene, rng = gallery(), np.random.default_rng(0)
    truth = Trajectory(walk.timestamps[list(TIMES)], walk.world_T_rigs[list(TIMES)])
    for time, world_T_rig in zip(TIMES, truth.world_T_rigs, strict=True):
        image = render_erp(scene, world_T_rig, WIDTH, WIDTH // 2)
        image = image + 2 * rng.standard_normal(image.shape)
        cv2.imwrite(str(folder / f"new{time}.png"), np.clip(image[..., ::-1], 0, 255))
    return folder, truth


@pytest.fixture(scope="module")
def localizer(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    return Localizer(case.copy(tmp_path_factory.mktemp("map") / "run"))


def test_new_frames_are_found_where_they_are(
    case: Case, localizer: Localizer, new: tuple[Path, Trajectory]
) -> None:
    folder, truth = new
    found = [localizer.localize(folder / f"new{time}.png") for time in TIMES]
    assert all(frame.found for frame in found)
    positions, rotations = _errors(case, found, truth)
    own = case.errors()
    assert np.median(positions) < 4 * own.ate.rmse + 2e-3
    assert np.median(rotations) < 0.1
    for frame, error in zip(found, positions, strict=True):
        sigma = np.sqrt(np.trace(frame.covariance[3:, 3:]))
        assert error < 5 * sigma + own.ate.max
        assert frame.num_points > 50
        assert frame.nearest in localizer.map.frames.names


def test_a_frame_in_memory_gives_the_pose_of_its_file(
    localizer: Localizer, new: tuple[Path, Trajectory]
) -> None:
    path = new[0] / "new5.png"
    image = np.ascontiguousarray(np.asarray(cv2.imread(str(path)))[..., ::-1])
    one, other = localizer.localize(path), localizer.localize(image, "x")
    np.testing.assert_array_equal(one.world_T_rig, other.world_T_rig)
    assert other.name == "x"


def test_the_run_stays_as_it_is_to_the_byte(
    case: Case, tmp_path: Path, new: tuple[Path, Trajectory]
) -> None:
    run = case.copy(tmp_path / "run")
    before = _contents(run)
    result = succeed("localize", run, new[0], "--out", tmp_path / "out")
    assert "3 of 3 pictures localised" in result.output
    assert _contents(run) == before
    written = json.loads((tmp_path / "out/localized.json").read_text())
    assert [picture["name"] for picture in written["pictures"]] == ["new2", "new5", "new8"]
    poses = read_trajectory(tmp_path / "out/trajectory.tum")
    np.testing.assert_allclose(
        poses.world_T_rigs[1], written["pictures"][1]["world_T_picture"], atol=1e-12
    )
    rows = (tmp_path / "out/poses.csv").read_text().splitlines()
    assert len(rows) == 4 and rows[1].split(",")[2] == "localised"


def test_a_picture_from_elsewhere_is_refused_in_one_line(case: Case, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    blocks = np.random.default_rng(3).integers(0, 255, (32, 64, 3)).astype(np.uint8)
    noise = cv2.resize(blocks, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(folder / "noise.png"), noise)
    (folder / "torn.jpg").write_bytes(b"\xff\xd8\xff\xe0 torn")
    call = ["localize", str(case.copy(tmp_path / "run")), str(folder), "--out", str(tmp_path / "o")]
    result = run_gsba(*call)
    assert result.exit_code == 3
    assert "noise: not localised: no place of the map looks like it" in result.output
    assert "torn: not localised: " in result.output
    assert (tmp_path / "o/trajectory.tum").read_text() == ""
    assert run_gsba(*call, "--allow-partial").exit_code == 0


def test_a_run_of_another_version_is_refused(case: Case, tmp_path: Path) -> None:
    run = case.copy(tmp_path / "run")
    marker = run / "gsba.json"
    marker.write_text(json.dumps(json.loads(marker.read_text()) | {"gsba": "0.0.1"}))
    with pytest.raises(GsbaError, match=r"is a run of gsba 0\.0\.1"):
        Localizer(run)


def test_no_run_and_an_output_folder_within_the_run_are_refused(
    case: Case, tmp_path: Path, new: tuple[Path, Trajectory]
) -> None:
    result = run_gsba("localize", tmp_path, new[0])
    assert result.exit_code == 1 and "is not a gsba run" in result.output
    inside = ["localize", str(case.out), str(new[0]), "--out", str(case.out / "poses")]
    result = run_gsba(*inside)
    assert result.exit_code == 1 and "stays as it is" in result.output


def test_the_index_is_kept_beside_the_run_and_made_again_if_it_is_damaged(
    case: Case, tmp_path: Path, new: tuple[Path, Trajectory]
) -> None:
    run = case.copy(tmp_path / "run")
    first = Localizer(run).localize(new[0] / "new2.png")
    kept = index_path(run)
    assert kept == tmp_path / "run-index/places.npz"
    stamp = kept.stat().st_mtime_ns
    Localizer(run)
    assert kept.stat().st_mtime_ns == stamp
    kept.write_bytes(b"damaged")
    again = Localizer(run).localize(new[0] / "new2.png")
    np.testing.assert_array_equal(first.world_T_rig, again.world_T_rig)
    assert kept.stat().st_size > 1000


def test_keypoints_that_the_run_no_longer_holds_are_extracted_again(
    case: Case, tmp_path: Path, new: tuple[Path, Trajectory]
) -> None:
    run = case.copy(tmp_path / "run")
    first = Localizer(run).localize(new[0] / "new2.png")
    for name in ("features", "features_closer"):
        shutil.rmtree(run / "stages" / name, ignore_errors=True)
    again = Localizer(run).localize(new[0] / "new2.png")
    assert again.found
    assert np.linalg.norm(again.world_T_rig[:3, 3] - first.world_T_rig[:3, 3]) < 5e-3


def _errors(
    case: Case, found: list[LocalizedFrame], truth: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of positions (gallery units) and rotations (deg) in the world of the truth."""
    mapped = read_trajectory(case.out / "trajectory.tum").world_T_rigs
    move = pose_similarity(mapped, case.truth.world_T_rigs)
    poses = move.poses(np.array([frame.world_T_rig for frame in found]))
    far = np.linalg.norm(poses[:, :3, 3] - truth.world_T_rigs[:, :3, 3], axis=1)
    turned = np.swapaxes(poses[:, :3, :3], 1, 2) @ truth.world_T_rigs[:, :3, :3]
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1) / 2
    return far, np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _contents(folder: Path) -> dict[str, str]:
    """Digest of each file below a folder."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
