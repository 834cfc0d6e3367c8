"""Stills of a tour whose descriptors tie nothing."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsba import GsbaError, refine
from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import FeatureSettings
from gsba.evaluate.trajectory import pose_errors
from gsba.features.detection import TRAITS
from gsba.geometry import unit
from gsba.odometry import tour_order, tour_steps
from gsba.pipeline.tour import rows_of_added, with_keypoints
from gsba.trajectory.files import read_trajectory
from gsba.types import Features, Trajectory
from tests.room_tour import picture, true_poses
from tests.tiny_run import settings_with

NUM = 3
WITHOUT_PATCHES = {"patches": {"rounds": 0}}


@pytest.fixture
def _no_descriptor_is_so_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TRAITS, "sift", replace(TRAITS["sift"], min_similarity=0.9999))


@pytest.fixture(scope="module")
def stills(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stills")
    for n in range(NUM):
        cv2.imwrite(str(folder / f"{n}.png"), picture(n))
    return folder


def test_searched_places_make_a_map_where_descriptors_make_none(
    stills: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = FeatureSettings(max_per_face=150)  # as many as this room needs
    monkeypatch.setattr(tour_steps, "_FEATURES", few)
    monkeypatch.setattr(tour_steps, "_NUM_KEYS", 200)
    settings = settings_with(**WITHOUT_PATCHES, export={"formats": ()})
    usual, strange = TRAITS["sift"], replace(TRAITS["sift"], min_similarity=0.9999)
    monkeypatch.setitem(TRAITS, "sift", strange)
    result = refine(stills, None, tmp_path / "run", settings, masks="none")
    found = read_trajectory(result.out / "trajectory.tum")
    assert len(found.timestamps) == NUM
    off = pose_errors(found, Trajectory(found.timestamps, true_poses()[:NUM]))
    assert off.positions.max() < 0.01 and np.rad2deg(off.rotations.max()) < 0.1
    stages = [stage["name"] for stage in result.report["stages"]]
    assert "tour" in stages
    assert (result.out / "stages/features_tour/0.npz").is_file()
    # Keypoints of the first call have other numbers than those of a call that needs no search.
    monkeypatch.setitem(TRAITS, "sift", usual)
    other = settings_with(**WITHOUT_PATCHES, export={"formats": ()}, pairs={"window": 31})
    again = refine(stills, None, result.out, other, masks="none")
    assert len(again.reconstruction.world_T_rigs) == NUM
    assert not (result.out / "stages/features_tour").exists()


@pytest.mark.usefixtures("_no_descriptor_is_so_alike")
@pytest.mark.parametrize(("pairs", "fps"), [({"max_tour_frames": 0}, None), ({}, 2.0)])
def test_frames_of_a_video_and_more_than_is_allowed_are_not_searched(
    stills: Path, tmp_path: Path, pairs: dict[str, int], fps: float | None
) -> None:
    settings = settings_with(**WITHOUT_PATCHES, pairs=pairs)
    with pytest.raises(GsbaError, match="no two neighbouring frames match"):
        refine(stills, None, tmp_path / "run", settings, masks="none", fps=fps)


def test_added_keypoints_follow_the_others_of_their_face() -> None:
    rng, rig = np.random.default_rng(0), CubeRig(64, np.pi / 2)
    rays = unit(rng.normal(size=(40, 3)))
    own, added = rays[np.argsort(owner_faces(rays[:25]), kind="stable")], rays[25:]
    faces = owner_faces(own)
    descriptors = np.full((25, 8), 7, np.uint8)
    colors = np.zeros((25, 3), np.uint8)
    before = Features(rig.project(own, faces), faces, own, np.full(25, 1e-3), descriptors, colors)
    pictures_rgb = np.full((6, 64, 64, 3), 9, np.uint8)
    found = with_keypoints(before, added, np.full(15, 2e-3), pictures_rgb, rig)
    rows = rows_of_added(faces, owner_faces(added))
    assert (np.diff(found.faces.astype(int)) >= 0).all() and len(found) == 40
    np.testing.assert_array_equal(found.bearings_rig[rows], added)
    np.testing.assert_array_equal(np.delete(found.bearings_rig, rows, axis=0), own)
    assert not found.descriptors[rows].any() and (found.colors[rows] == 9).all()
    np.testing.assert_allclose(
        rig.bearings(found.pixels[rows], 0)[found.faces[rows] == 0],
        added[owner_faces(added) == 0],
        atol=1e-12,
    )


@pytest.mark.slow
def test_stills_in_no_order_are_refined_in_the_one_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tour_steps, "_FEATURES", FeatureSettings(max_per_face=150))
    monkeypatch.setattr(tour_steps, "_NUM_KEYS", 400)
    monkeypatch.setattr(tour_order, "MIN_FRAMES", 4)
    monkeypatch.setitem(TRAITS, "sift", replace(TRAITS["sift"], min_similarity=0.9999))
    frames, way = tmp_path / "stills", [2, 0, 3, 1]
    frames.mkdir()
    for n, still in enumerate(way):
        cv2.imwrite(str(frames / f"{n}.png"), picture(still))
    settings = settings_with(**WITHOUT_PATCHES, export={"formats": ()})
    result = refine(frames, None, tmp_path / "run", settings, masks="none")
    stills = [way[int(name)] for name in result.frames.names]
    assert stills in ([0, 1, 2, 3], [3, 2, 1, 0])
    found = read_trajectory(result.out / "trajectory.tum")
    off = pose_errors(found, Trajectory(found.timestamps, true_poses()[stills]))
    assert off.positions.max() < 0.01 and np.rad2deg(off.rotations.max()) < 0.1
    again = refine(frames, None, tmp_path / "run", settings, masks="none")
    assert again.frames.names == result.frames.names
    resumed = {stage["name"]: stage["resumed"] for stage in again.report["stages"]}
    assert resumed["tour"] and resumed["reconstruction"]
