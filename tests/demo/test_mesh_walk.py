"""Walks through meshes of the user's own: in free space, seen as the mesh is."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsba.demo import make_mesh_walk
from gsba.demo.free_path import free_path
from gsba.demo.mesh_walk import MeshScene
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory

SIZE = np.array([8.0, 3.0, 6.0])  # x, y down, z


def _room(path: Path, colored: bool = True) -> Path:
    """A room as a PLY mesh, z up, each corner of a colour of its own."""
    o3d = pytest.importorskip("open3d", reason="open3d is not installed: pip install 'gsba[scan]'")
    mesh = o3d.geometry.TriangleMesh.create_box(8.0, 6.0, 3.0)
    if colored:
        mesh.vertex_colors = o3d.utility.Vector3dVector(np.asarray(mesh.vertices) / [8, 6, 3])
    o3d.io.write_triangle_mesh(str(path), mesh)
    return path


def test_a_way_keeps_off_what_stands_there() -> None:
    """An empty room with a pillar in the middle, by its exact distances."""
    pillar = np.array([4.0, 3.0])

    def clearance(points: np.ndarray) -> np.ndarray:
        walls = np.minimum(points, SIZE - points).min(axis=1)
        return np.minimum(walls, np.linalg.norm(points[:, [0, 2]] - pillar, axis=1) - 0.7)

    def seen(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
        return SIZE[1] - points[:, 1] if direction[1] > 0 else points[:, 1]

    positions, room = free_path(np.zeros(3), SIZE, clearance, seen, 40)
    assert positions is not None and positions.shape == (40, 3)
    assert clearance(positions).min() > 0.2 and room > 0.2
    steps = np.linalg.norm(np.diff(positions, axis=0, append=positions[:1]), axis=1)
    assert steps.max() < 1.5 * np.median(steps)  # evenly, and closed
    around = np.unwrap(np.arctan2(*(positions[:, [0, 2]] - pillar).T))
    assert np.ptp(positions[:, 0]) > 3 and abs(around[-1] - around[0]) > 4
    nothing = free_path(np.zeros(3), SIZE, lambda p: np.zeros(len(p)), seen, 40)
    assert nothing[0] is None


def test_a_room_is_walked_and_seen(tmp_path: Path) -> None:
    mesh = _room(tmp_path / "room.ply")
    walk = make_mesh_walk(tmp_path / "walk", mesh, num_frames=4, width=64)
    truth = read_trajectory(walk.truth_path)
    at = truth.world_T_rigs[:, :3, 3]
    assert ((at > 0.2) & (at < np.array([8, 6, 3]) - 0.2)).all()
    assert (truth.world_T_rigs[:, 2, 1] < -0.99).all()  # the rigs' down is the world's
    picture = cv2.imread(str(walk.frames_dir / "000000.jpg"))[..., ::-1].astype(float)
    assert picture[2].mean(axis=0)[2] > picture[-3].mean(axis=0)[2] + 150  # blue is up
    again = make_mesh_walk(tmp_path / "again", mesh, walk.truth_path, width=64)
    np.testing.assert_allclose(
        read_trajectory(again.truth_path).world_T_rigs, truth.world_T_rigs, atol=1e-6
    )


def test_what_cannot_be_walked_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GsbaError, match="neither a texture nor vertex colours"):
        make_mesh_walk(tmp_path / "walk", _room(tmp_path / "grey.ply", colored=False))
    with pytest.raises(GsbaError, match="no such file"):
        make_mesh_walk(tmp_path / "walk", tmp_path / "none.obj")
    assert not (tmp_path / "walk").exists()


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_textures_stand_upright(tmp_path: Path, suffix: str) -> None:
    """A wall ahead of a camera in a world with y up, its picture red above and blue below."""
    pytest.importorskip("open3d", reason="open3d is not installed: pip install 'gsba[scan]'")
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :, 0], picture[32:, :, 2] = 255, 255
    corners = np.array([[-1.0, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1]])
    uvs = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])  # v up, as OBJ has it
    path = tmp_path / f"wall.{suffix}"
    if suffix == "obj":
        cv2.imwrite(str(tmp_path / "wall.png"), picture[..., ::-1])
        (tmp_path / "wall.mtl").write_text("newmtl wall\nmap_Kd wall.png\n")
        lines = ["mtllib wall.mtl", "usemtl wall", *(f"v {x} {y} {z}" for x, y, z in corners)]
        lines += [f"vt {u} {v}" for u, v in uvs] + ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
        path.write_text("\n".join([*lines, ""]))
    else:
        trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed")
        image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image.fromarray(picture))
        mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
        mesh.visual = trimesh.visual.TextureVisuals(uv=uvs, material=material)
        mesh.export(path)
    seen = MeshScene(path).picture(np.diag([1.0, -1, -1, 1]), 64)
    assert seen[12, 32, 0] > 200 > 50 > seen[12, 32, 2]
    assert seen[20, 32, 2] > 200 > 50 > seen[20, 32, 0]
