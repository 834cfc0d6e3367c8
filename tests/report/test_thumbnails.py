"""Small panoramas of the report, and what is drawn into them."""

import base64
import dataclasses
from pathlib import Path

import cv2
import export_scene as scene
import numpy as np
import pytest
from plain_records import frames_of

from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.report.html import thumbnails
from gsba.report.html.thumbnails import frame_pictures
from gsba.types import Fisheye, FrameSet, PictureFormat

SIDE = 340  # pixels, at 100 a radian: the edge is 1.7 rad from the axis
LENS = Fisheye(SIDE, SIDE, 100.0, (SIDE / 2, SIDE / 2), (0, 0, 0, 0), (0, 0, 0))
BACK = dataclasses.replace(LENS, rotation=(0.0, np.pi, 0.0))
RAW = PictureFormat("fisheye", 628, 314, fisheyes=(LENS, BACK))


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> FrameSet:
    return scene.panoramas(tmp_path_factory.mktemp("thumbnails") / "images")


def decoded(text: str) -> np.ndarray:
    found = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found


def test_matches_are_those_of_neighbours_and_the_worst_are_kept(frames: FrameSet) -> None:
    result = scene.reconstruction()
    row = int(np.flatnonzero(result.observation_frames == 3)[7])
    bearings = result.observation_bearings.copy()
    turn = np.radians(2.0)  # one direction is 2 degrees off, to the east
    x, y, z = bearings[row]
    bearings[row] = [np.cos(turn) * x + np.sin(turn) * z, y, np.cos(turn) * z - np.sin(turn) * x]
    result = dataclasses.replace(result, observation_bearings=bearings)
    matches = frame_pictures(frames, result, None)["matches"]
    num, most = len(scene.POINTS), thumbnails._MAX_MATCHES
    assert matches["shared"].tolist() == [num] * (len(frames) - 1)
    assert matches["counts"].tolist() == [min(num, most)] * (len(frames) - 1)
    data = np.frombuffer(base64.b64decode(matches["data"]), "<u2").reshape(-1, 5)
    starts = np.concatenate([[0], np.cumsum(matches["counts"])])
    place = np.mod(erp_from_bearings(bearings[row], 1, 1), 1)
    off = np.degrees(turn) * np.hypot(x, z)  # a turn about the vertical axis
    for pair, columns in ((2, (2, 3)), (3, (0, 1))):
        mine = data[starts[pair] : starts[pair + 1]]
        worst = mine[np.argmax(mine[:, 4])]
        np.testing.assert_allclose(worst[list(columns)] / 65535, place, atol=1e-4)
        assert worst[4] / 1000 == pytest.approx(off, rel=0.02)
        assert np.sort(mine[:, 4])[-2] <= 1
    assert data[starts[5] : starts[6], 4].max() <= 1


def test_long_runs_show_some_frames_within_the_budget(
    frames: FrameSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thumbnails, "MAX_PICTURES", 3)
    best = frame_pictures(frames, scene.reconstruction(), None)
    assert best["shown"] == [0, 4, 8] and decoded(best["jpegs"][1]).shape == (256, 512, 3)
    monkeypatch.setattr(thumbnails, "_MAX_BYTES", 3 * 9_000)
    many = frame_pictures(frames, scene.reconstruction(), None)["jpegs"]
    assert decoded(many[1]).shape == (128, 256, 3)
    monkeypatch.setattr(thumbnails, "_MAX_BYTES", 1)
    small = frame_pictures(frames, scene.reconstruction(), None)["jpegs"]
    assert sum(map(len, small)) < 0.7 * sum(map(len, many))


def test_a_mask_of_all_frames_is_held_once(frames: FrameSet, tmp_path: Path) -> None:
    kind = frames.format
    mask = np.full((kind.height, kind.width), 255, np.uint8)
    mask[kind.height // 2 :] = 0
    cv2.imwrite(str(tmp_path / "carrier.png"), mask)
    masked = dataclasses.replace(
        frames, mask_paths=(None, *[tmp_path / "carrier.png"] * (len(frames) - 1))
    )
    found = frame_pictures(masked, scene.reconstruction(), None)
    assert found["mask"] == [-1] + [0] * (len(frames) - 1) and len(found["masks"]) == 1
    alpha = decoded(found["masks"][0])[..., 3]
    assert (alpha[:31] == 0).all() and (alpha[33:] > 0).all()


def test_seam_and_edges_of_raw_lenses(frames: FrameSet) -> None:
    ((seam,),) = (thumbnails._seams(RAW, False),)
    np.testing.assert_allclose(np.abs(np.mod(seam[:, 0], 1) - 0.5), 0.25, atol=1e-3)
    edges = thumbnails._circles(RAW)
    for line, axis in zip(edges, ([0, 0, 1], [0, 0, -1]), strict=True):
        angles = np.arccos(bearings_from_erp(line, 1, 1) @ axis)
        np.testing.assert_allclose(angles, 1.7, atol=1e-3)
    assert thumbnails._seams(frames.format, False) == []  # one centre: there is no seam
    assert len(thumbnails._seams(frames.format, True)) == 1


def test_raw_lenses_are_joined_at_a_part_of_their_size(tmp_path: Path) -> None:
    """Front red, back blue, and a green spot that lies to the right of the front."""
    front = np.full((SIDE, SIDE, 3), (0, 0, 255), np.uint8)
    front[160:180, 235:265] = (0, 255, 0)  # 0.8 rad to the right
    cv2.imwrite(str(tmp_path / "f.png"), front)
    cv2.imwrite(str(tmp_path / "b.png"), np.full((SIDE, SIDE, 3), (255, 0, 0), np.uint8))
    frames = frames_of(RAW, [(tmp_path / "f.png", tmp_path / "b.png")])
    image = thumbnails.small_panorama(frames, 0, 200)
    assert image.shape == (100, 200, 3)
    assert image[50, 100].tolist() == [255, 0, 0] and image[50, 5].tolist() == [0, 0, 255]
    assert image[50, 100 + round(0.8 / np.pi * 100)].tolist() == [0, 255, 0]
