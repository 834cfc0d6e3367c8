"""OpenSfM projects, read by the rules of its io.py, tracks_manager.cc and spherical camera."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from export_scene import (
    COLORS,
    HEIGHT,
    NUM_FRAMES,
    POINTS,
    WIDTH,
    assert_blob,
    cube_frames,
    exported,
    panoramas,
    reconstruction,
)
from scipy.spatial.transform import Rotation

from gsba.export import ExportFormat, export
from gsba.log import GsbaError
from gsba.placement.world import Placement, read_placement
from gsba.similarity import Sim3

_FOCAL = WIDTH / (2 * np.pi)  # pixels a radian in the middle of a panorama


def _read(folder: Path) -> dict:
    (project,) = json.loads((folder / "reconstruction.json").read_text())
    assert json.loads((folder / "camera_models.json").read_text()) == project["cameras"]
    return project


def _projected(shot: dict, points: np.ndarray) -> np.ndarray:
    """Normalised coordinates (J, 2) of points by OpenSfM's pose and spherical camera."""
    rotation = Rotation.from_rotvec(shot["rotation"]).as_matrix()
    x, y, z = (points @ rotation.T + shot["translation"]).T
    lon, lat = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    return np.column_stack([lon, -lat]) / (2 * np.pi)


def test_opensfm_sees_points_where_the_panoramas_do(tmp_path: Path) -> None:
    frames, out = panoramas(tmp_path / "frames", masked=True), tmp_path / "out"
    export(reconstruction(), frames, out, ExportFormat.OPENSFM)
    project = _read(out)
    points = np.array([project["points"][str(j)]["coordinates"] for j in range(len(POINTS))])
    colors = [project["points"][str(j)]["color"] for j in range(len(POINTS))]
    np.testing.assert_array_equal(colors, COLORS)
    looked = 0
    for name, shot in project["shots"].items():
        camera = project["cameras"][shot["camera"]]
        assert camera == {"projection_type": "spherical", "width": WIDTH, "height": HEIGHT}
        assert (out / "masks" / f"{name}.png").is_file()
        image = cv2.imread(str(out / "images" / name))
        for at, color in zip(_projected(shot, points), COLORS, strict=True):
            pixel = at * WIDTH + np.array([WIDTH, HEIGHT]) / 2
            # Towards the poles, panoramas stretch blobs and shift their middles.
            if abs(at[1]) < 0.12:
                looked += assert_blob(image[..., ::-1], pixel, color, _FOCAL)
    assert looked > 5 * NUM_FRAMES
    assert list(project["shots"]) == [f"{name}.png" for name in frames.names]


def test_tracks_are_the_observations_of_the_points(tmp_path: Path) -> None:
    out = exported(tmp_path, ExportFormat.OPENSFM)
    project = _read(out)
    header, *lines = (out / "tracks.csv").read_text().splitlines()
    assert header == "OPENSFM_TRACKS_VERSION_v2"
    rows = [line.split("\t") for line in lines]
    assert len(rows) == len(POINTS) * NUM_FRAMES and {len(row) for row in rows} == {11}
    assert len({(row[0], row[2]) for row in rows}) == len(rows)  # one feature an observation
    for shot, track, _, x, y, scale, *color, segment, instance in rows:
        point = project["points"][track]
        expected = _projected(project["shots"][shot], np.array([point["coordinates"]]))[0]
        np.testing.assert_allclose([float(x), float(y)], expected, atol=1e-8)
        assert float(scale) == pytest.approx(1e-3 / (2 * np.pi), rel=1e-4)
        assert [int(value) for value in color] == point["color"]
        assert (segment, instance) == ("-1", "-1")


@pytest.mark.parametrize("up", [None, "-y", "y", "z"])
def test_z_points_up_and_the_placement_says_so(up: str | None, tmp_path: Path) -> None:
    """transform.json takes the run's points to the exported ones, of which z points up."""
    axes = {"y": np.diag([1.0, -1, -1]), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
    move = Sim3(2.0, axes.get(up or "", np.eye(3)), np.array([1.0, 2, 3]))
    origin = (46.5, 7.25, 800.0) if up == "z" else None
    placement = Placement(move, up=up, origin=origin)
    out = exported(tmp_path, ExportFormat.OPENSFM, placement=placement)
    project = _read(out)
    points = np.array([project["points"][str(j)]["coordinates"] for j in range(len(POINTS))])
    heights = points[:, 2] - points[:, 2].mean()
    np.testing.assert_allclose(heights, -2 * (POINTS[:, 1] - POINTS[:, 1].mean()), atol=1e-9)
    told = read_placement(out / "transform.json")
    np.testing.assert_allclose(told.similarity.points(POINTS), points, atol=1e-9)
    assert told.up == (up and "z")
    if origin is None:
        assert "reference_lla" not in project and not (out / "reference_lla.json").exists()
    else:
        reference = json.loads((out / "reference_lla.json").read_text())
        assert reference == {"latitude": 46.5, "longitude": 7.25, "altitude": 800.0}
        assert project["reference_lla"] == reference
        np.testing.assert_allclose(points, move.points(POINTS), atol=1e-9)  # east, north, up


def test_pictures_of_several_recordings_lie_in_one_folder(tmp_path: Path) -> None:
    frames = panoramas(tmp_path / "frames")
    names = tuple(f"{'a' if f < 4 else 'b'}/{f % 4}{f // 8}" for f in range(NUM_FRAMES))
    frames = replace(frames, names=names, clock_shifts=(0.0,) * NUM_FRAMES)
    export(reconstruction(), frames, tmp_path / "out", ExportFormat.OPENSFM)
    shots = set(_read(tmp_path / "out")["shots"])
    assert shots == {f"{name.replace('/', '_')}.png" for name in names}
    assert shots == {path.name for path in (tmp_path / "out/images").iterdir()}


def test_what_opensfm_cannot_hold_is_refused(tmp_path: Path) -> None:
    cubes, out = cube_frames(tmp_path / "cube", 32), tmp_path / "out"
    with pytest.raises(GsbaError, match="opensfm needs panoramas, these frames are cube faces"):
        export(reconstruction(), cubes, out, ExportFormat.OPENSFM)
    frames = panoramas(tmp_path / "frames")
    names = ("a/b_c", "a_b/c", *(f"a/{f}" for f in range(2, NUM_FRAMES)))
    frames = replace(frames, names=names, clock_shifts=(0.0,) * NUM_FRAMES)
    with pytest.raises(GsbaError, match="would both be named 'a_b_c'"):
        export(reconstruction(), frames, out, ExportFormat.OPENSFM)
    assert not out.exists()
