"""The splat's record: its start from a cloud, and its PLY file."""

from pathlib import Path

import numpy as np
import plyfile
import pytest
from refusals import refused
from synthetic import unit

from gsba.splat.gaussians import SH_CONSTANT, Gaussians, from_cloud, read_ply, write_ply


def some(num: int = 7, harmonics: int = 16) -> Gaussians:
    rng = np.random.default_rng(0)
    quaternions = unit(rng.normal(size=(num, 4)))
    parts = (rng.normal(size=(num, 3)), rng.normal(size=(num, 3)), quaternions)
    parts += (rng.normal(size=num), rng.normal(size=(num, harmonics, 3)))
    return Gaussians(*(part.astype(np.float32) for part in parts))


@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
def test_file_comes_back_as_it_was(tmp_path: Path, harmonics: int) -> None:
    path, before = tmp_path / "point_cloud.ply", some(harmonics=harmonics)
    write_ply(path, before)
    for one, other in zip(before.arrays(), read_ply(path).arrays(), strict=True):
        assert one.shape == other.shape and np.allclose(one, other, atol=1e-6)


def test_layout_is_that_of_inria(tmp_path: Path) -> None:
    path, gaussians = tmp_path / "point_cloud.ply", some()
    write_ply(path, gaussians)
    vertex = plyfile.PlyData.read(path)["vertex"]
    assert len(vertex.properties) == 62 and vertex.properties[3].name == "nx"
    assert np.allclose(vertex["f_rest_15"], gaussians.sh[:, 1, 1])  # channel after channel
    assert np.allclose(vertex["rot_0"], gaussians.quaternions[:, 0])
    assert path.stat().st_size - path.read_bytes().find(b"end_header\n") - 11 == 7 * 248


def test_properties_are_found_by_name(tmp_path: Path) -> None:
    """Other writers leave out the normals."""
    path = tmp_path / "other.ply"
    write_ply(path, some(3, 1))
    header, _, body = path.read_bytes().partition(b"end_header\n")
    rows = np.delete(np.frombuffer(body, "<f4").reshape(3, -1), [3, 4, 5], axis=1)
    for name in (b"nx", b"ny", b"nz"):
        header = header.replace(b"property float %s\n" % name, b"")
    path.write_bytes(header + b"end_header\n" + rows.tobytes())
    assert np.allclose(read_ply(path).means, some(3, 1).means)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data[:-1], "truncated"),
        (lambda data: data[:100], "header is damaged"),
        (lambda data: b"", "not a PLY"),
        (lambda data: b"\x89PNG" + data, "not a PLY"),
        (lambda data: data.replace(b"opacity", b"intense"), "no property 'opacity'"),
        (lambda data: data.replace(b"float f_rest_44", b"float some_thing"), "44 f_rest"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "damaged"),
        (lambda data: data.replace(b"property float x", b"property list y x"), "header is damaged"),
        (lambda data: data.replace(b"property float x", b"property list int int x"), "."),
        (lambda data: data.replace(b"element vertex", b"element corner"), "no element 'vertex'"),
        (lambda data: data.replace(b"vertex 7", b"vertex " + b"9" * 50), "truncated or damaged"),
        (lambda data: data.replace(b"vertex 7", b"vertex -1"), "damaged"),
        (lambda data: data[:-4] + b"\xff\xff\xff\xff", "not finite"),
    ],
)
def test_other_files_are_refused_in_one_line(tmp_path: Path, spoil, message: str) -> None:
    path = tmp_path / "point_cloud.ply"
    write_ply(path, some())
    path.write_bytes(spoil(path.read_bytes()))
    assert str(path) in refused(message, read_ply, path)


def test_start_from_a_cloud() -> None:
    points = np.array([[x, y, z] for x in range(4) for y in range(4) for z in range(4)], float)
    colors = np.full((64, 3), [255, 0, 128], np.uint8)
    gaussians = from_cloud(points, colors, sh_degree=2)
    assert gaussians.sh_degree == 2 and len(gaussians) == 64
    assert np.allclose(np.exp(gaussians.log_scales), 0.1 * np.linalg.norm(points.std(axis=0)))
    fine = from_cloud(points * [1, 1, 100], colors)  # neighbours now lie in a plane, 1 apart
    assert np.allclose(np.exp(fine.log_scales[21]), np.sqrt((1 + 1 + 1) / 3))
    assert np.allclose(0.5 + SH_CONSTANT * gaussians.sh[0, 0], [1, 0, 128 / 255], atol=1e-6)
    assert np.allclose(1 / (1 + np.exp(-gaussians.opacity_logits)), 0.1)


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((2, 3), np.nan)])
def test_a_cloud_of_nothing_is_refused(points: np.ndarray) -> None:
    refused("cloud has", from_cloud, points, np.zeros((len(points), 3), np.uint8))


@pytest.mark.parametrize("num", [1, 5])
def test_points_on_one_spot_have_a_width(num: int) -> None:
    assert from_cloud(np.zeros((num, 3)), np.zeros((num, 3), np.uint8)).is_finite()
