"""Scans read from their files, as the libraries of others write them; distances to them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from command import fails, run_gsba
from refusals import refused
from scan_world import HALL, SIZE, rectangles, sampled

from gsba.config import PlacementSettings
from gsba.placement.placement import check
from gsba.scans import check_scan, distances_to, files, read_pairs, read_scan
from gsba.scans.files import on_planes
from gsba.scans.types import Scan

FAR = np.array([412_300.0, 5_655_800.0, 110.0])


def _open3d():
    return pytest.importorskip("open3d", reason="open3d is not installed: pip install 'gsba[scan]'")


def _points(num: int = 4000) -> np.ndarray:
    return sampled(np.random.default_rng(0), rectangles(SIZE, HALL), num)[0]


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_clouds(tmp_path: Path, suffix: str) -> None:
    o3d, points = _open3d(), _points()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    shade = np.linspace(0, 1, len(points))
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(shade[:, None], 3, axis=1))
    o3d.io.write_point_cloud(str(tmp_path / f"scan.{suffix}"), cloud)
    scan = read_scan(tmp_path / f"scan.{suffix}")
    np.testing.assert_allclose(scan.points, points, atol=1e-5)
    np.testing.assert_array_equal(scan.offset, 0)
    assert scan.brightness is not None
    np.testing.assert_allclose(scan.brightness, shade, atol=0.01)
    flat = np.abs(scan.normals).max(axis=1)
    assert np.median(flat) > 0.98  # walls are square to an axis, but for where they meet


@pytest.mark.parametrize("suffix", ["obj", "glb", "ply"])
def test_meshes(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    o3d = _open3d()
    monkeypatch.setattr(files, "_NUM_MESH_SAMPLES", 20_000)
    box = o3d.geometry.TriangleMesh.create_box(4.0, 3.0, 2.0)
    path = tmp_path / f"scan.{suffix}"
    if suffix == "glb":  # open3d writes none that it can read
        trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
        trimesh.Trimesh(np.asarray(box.vertices), np.asarray(box.triangles)).export(path)
    else:
        o3d.io.write_triangle_mesh(str(path), box)
    scan = read_scan(path)
    sides = np.minimum(np.abs(scan.points), np.abs(scan.points - [4, 3, 2])).min(axis=1)
    assert sides.max() < 0.02 and np.median(sides) < 1e-6
    assert scan.points.max(axis=0) == pytest.approx([4, 3, 2], abs=1e-3)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_laser_scans_keep_their_digits(tmp_path: Path, suffix: str) -> None:
    _open3d()
    laspy = pytest.importorskip("laspy", reason="laspy is not installed")
    points = _points()
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.offsets, header.scales = FAR, np.full(3, 1e-4)
    file = laspy.LasData(header)
    file.x, file.y, file.z = (points + FAR).T
    file.write(str(tmp_path / f"scan.{suffix}"))
    scan = read_scan(tmp_path / f"scan.{suffix}")
    np.testing.assert_allclose(scan.points + (scan.offset - FAR), points, atol=1e-4)
    assert np.abs(scan.points).max() < 1000 and scan.brightness is None  # all black: no colours


def test_what_is_no_scan_is_refused_in_one_line(tmp_path: Path) -> None:
    _open3d()
    (tmp_path / "a.txt").write_text("1 2 3")
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    (tmp_path / "a.las").write_text("LASF")
    (tmp_path / "a.ply").write_text("ply\n")
    for name, message in {
        "a.txt": "is no scan",
        "b.ply": "cannot be read",
        "a.obj": "no triangles",
        "a.las": "cannot be read",
        "a.ply": r"to its end \(RPly: Unexpected end of file\)",
    }.items():
        refused(message, read_scan, tmp_path / name)


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.ply").write_text("ply\n")
    monkeypatch.setitem(sys.modules, "open3d", None)
    refused(r"pip install 'gsba\[scan\]'", check_scan, tmp_path / "a.ply")


def test_pairs(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("# run, scan\nframe 7 1,2,3\n0.5,1,-2 4,5,6\nb 7,8,9.5\n")
    ends, points = read_pairs(path)
    assert ends == ["frame 7", "0.5,1,-2", "b"]
    np.testing.assert_array_equal(points, [[1, 2, 3], [4, 5, 6], [7, 8, 9.5]])
    for text, message in (("a 1,2\n", "pairs.txt:1"), ("a 1,2,3\n", "holds 1 pairs; 3 are needed")):
        path.write_text(text)
        refused(message, read_pairs, path)


def test_distances_are_to_surfaces_and_not_to_the_next_point() -> None:
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    flat = np.stack([x.ravel(), y.ravel(), np.zeros(400)], axis=1)
    scan = Scan(flat, np.tile([0.0, 0, 1], (400, 1)))
    found = distances_to(scan, np.array([[5.4, 5.5, 0.25], [5.5, 5.5, -0.1], [25.0, 19, 0]]))
    np.testing.assert_allclose(found, [0.25, 0.1, 6.0])


def test_settings_that_exclude_one_another(tmp_path: Path) -> None:
    refused("--pairs needs a scan", check, PlacementSettings(pairs="p.txt"))
    fails(run_gsba("evaluate", tmp_path, "--pairs", "p.txt"), "give --scan FILE")


def test_noise_shrinks_on_planes_and_steps_stay() -> None:
    """Two floors with a step of ten times the noise between them."""
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(0, 2, (20_000, 2)), np.zeros(20_000)])
    flat[:, 2] = np.where(flat[:, 0] < 1, 0.0, 0.05)
    laid, normals, scatters = on_planes(flat + 0.005 * rng.standard_normal(flat.shape))
    inner = np.abs(flat[:, 0] - 1) > 0.1
    assert np.std(laid[inner, 2] - flat[inner, 2]) < 0.005 / 3
    assert np.median(np.abs(normals[inner, 2])) > 0.98 and (scatters[inner] == 0).mean() > 0.95
    exact = on_planes(flat)[0]
    assert np.abs(exact - flat).max() < 1e-9  # nothing is smoothed but noise
