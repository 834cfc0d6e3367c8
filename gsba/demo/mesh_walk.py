"""Walk through a user's mesh, rendered by open3d's ray caster; the truth is in the mesh's world."""

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsba.camera.sphere import erp_directions
from gsba.demo.free_path import free_path
from gsba.demo.walk import DemoWalk, check_walk, held_by_hand, walk_folder, write_frames
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.scans.files import MESHES, open3d, read_mesh, upwards
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

logger = logging.getLogger(__name__)

_RAYS_PER_PIXEL = 2  # along either axis
_LOOKUP_WIDTH = 8192  # pixels of the images that OpenCV samples textures for
_LEVEL = {  # rotation (3, 3) from x right, y down, z forward to a world with an axis up
    "y": np.diag([1.0, -1, -1]),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}


class MeshScene:
    """Mesh for ray casting, in its own world."""

    def __init__(self, path: Path) -> None:
        """Read a mesh with colours. Raises GsbaError: the mesh cannot be read, or has neither
        textures nor colours."""
        if path.suffix.lower() not in (".ply", *MESHES):
            raise GsbaError(f"{path} is no mesh: give a file of .ply, {', '.join(MESHES)}")
        if not path.is_file():
            raise GsbaError(f"{path}: no such file")
        mesh = read_mesh(path)
        self.triangles = np.asarray(mesh.triangles)
        self.textures = [_rgb(np.asarray(t)) for t in mesh.textures if not t.is_empty()]
        self.uvs = np.asarray(mesh.triangle_uvs).reshape(-1, 3, 2)
        self.materials = np.asarray(mesh.triangle_material_ids)
        textured = len(self.uvs) == len(self.triangles) and len(self.textures) > 0
        self.colors = 255 * np.asarray(mesh.vertex_colors)
        if not textured and not len(self.colors):
            raise GsbaError(
                f"{path} has neither a texture nor vertex colours, so that frames of it cannot be "
                "matched: export it with colours"
            )
        if not textured:
            self.textures = []
        if len(self.materials) != len(self.triangles) or len(self.textures) == 1:
            self.materials = np.zeros(len(self.triangles), np.int64)
        if self.textures and self.materials.max() >= len(self.textures):
            raise GsbaError(f"{path} has materials without a texture: bake them into one")
        o3d = open3d()
        vertices = np.asarray(mesh.vertices, np.float64)
        self.low, self.high = vertices.min(axis=0), vertices.max(axis=0)
        self.caster: Any = o3d.t.geometry.RaycastingScene()
        self.caster.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)),
            o3d.core.Tensor(self.triangles.astype(np.uint32)),
        )
        self._tensor = o3d.core.Tensor

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> dict[str, np.ndarray]:
        """First hits of rays (N, 3): t_hit (N,), primitive_ids (N,), primitive_uvs (N, 2)."""
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        found = self.caster.cast_rays(self._tensor(rays))
        return {name: found[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Distances (N,) of points (N, 3) to the nearest surface."""
        return self.caster.compute_distance(self._tensor(points.astype(np.float32))).numpy()

    def picture(self, world_T_rig: np.ndarray, width: int) -> np.ndarray:
        """Panorama (width / 2, width, 3) float32, RGB, 0..255, averaged over each pixel."""
        wide, high = _RAYS_PER_PIXEL * width, _RAYS_PER_PIXEL * width // 2
        rays = erp_directions(wide).reshape(-1, 3)
        origin = np.broadcast_to(world_T_rig[:3, 3], rays.shape)
        found = self.cast(origin, rays @ world_T_rig[:3, :3].T)
        # colour of rays that hit nothing
        colors = np.broadcast_to(np.array([150.0, 170, 200]), rays.shape).copy()
        hit = np.isfinite(found["t_hit"])
        colors[hit] = self._colors(found["primitive_ids"][hit], found["primitive_uvs"][hit])
        fine = colors.reshape(high, wide, 3).astype(np.float32)
        return cv2.resize(fine, (width, width // 2), interpolation=cv2.INTER_AREA)

    def _colors(self, faces: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Colours (N, 3) at barycentric coordinates (N, 2) of triangles (N,)."""
        weights = np.column_stack([1 - at.sum(axis=1), at])
        if not self.textures:
            return np.einsum("nk,nkc->nc", weights, self.colors[self.triangles[faces]])
        colors = np.zeros((len(faces), 3))
        uvs = np.einsum("nk,nkc->nc", weights, self.uvs[faces])
        for n, texture in enumerate(self.textures):
            mine = self.materials[faces] == n
            if mine.any():
                colors[mine] = _texture_colors(texture, uvs[mine])
        return colors


def make_mesh_walk(
    out: Path,
    mesh: Path,
    path: Path | None = None,
    num_frames: int = 40,
    width: int = 1024,
    seed: int = 0,
) -> DemoWalk:
    """Render a walk through a mesh into the folder `out`; an earlier walk there is replaced.

    Args:
        mesh: OBJ, GLB, glTF or PLY with a texture or colours.
        path: TUM file of the poses to render, in the mesh's world; None = a closed path through
            free space is computed.
        num_frames: number of frames of a computed path, at least 3.
        width, seed: see `gsba.demo.make_walk`.

    Raises:
        GsbaError: an argument is out of range, `out` is not a walk's folder, the mesh cannot be
            used, or it has no free room for a path.
    """
    check_walk(out, num_frames, width, seed)
    truth = None if path is None else read_trajectory(path)
    if truth is not None and len(truth.timestamps) < 3:
        raise GsbaError(f"{path} has {len(truth.timestamps)} poses: at least 3 are needed")
    scene = MeshScene(mesh)
    if truth is None:
        truth = _free_walk(scene, mesh, num_frames, seed)
    logger.info("%s: %d triangles, %d frames", mesh, len(scene.triangles), len(truth.timestamps))
    with walk_folder(out, truth, seed) as partial:
        pictures = (scene.picture(world_T_rig, width) for world_T_rig in truth.world_T_rigs)
        write_frames(partial, truth, pictures, seed)
    return DemoWalk(out / "images", out / "groundtruth.tum", out / "slam.tum", None)


def _free_walk(scene: MeshScene, path: Path, num_frames: int, seed: int) -> Trajectory:
    """Closed walk through the mesh's free space with a fixed heading, in its world."""
    world_R_level = _LEVEL[upwards(path)]
    corners = np.stack([scene.low, scene.high]) @ world_R_level

    def clearance(points: np.ndarray) -> np.ndarray:
        return scene.clearance(points @ world_R_level.T)

    def seen(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
        along = np.broadcast_to(world_R_level @ direction, points.shape)
        return scene.cast(points @ world_R_level.T, along)["t_hit"]

    low, high = corners.min(axis=0), corners.max(axis=0)
    positions, room = free_path(low, high, clearance, seen, num_frames)
    if positions is None:
        raise GsbaError(f"{path} has no free room for a path: give poses by --path FILE")
    level = held_by_hand(positions, 0.0, np.random.default_rng(seed), unit=min(room, 1.0))
    rotations = world_R_level @ level.world_T_rigs[:, :3, :3]
    return Trajectory(
        level.timestamps, pose(rotations, level.world_T_rigs[:, :3, 3] @ world_R_level.T)
    )


def _rgb(texture: np.ndarray) -> np.ndarray:
    """Texture as (H, W, 3) float32, 0..255."""
    image = texture.reshape(*texture.shape[:2], -1).astype(np.float32)
    return np.repeat(image, 3, axis=2)[..., :3] if image.shape[2] < 3 else image[..., :3].copy()


def _texture_colors(texture: np.ndarray, uvs: np.ndarray) -> np.ndarray:
    """Colours (N, 3) at texture coordinates (N, 2), which repeat; v counts from the first row."""
    at = np.mod(uvs, 1.0) * texture.shape[1::-1] - 0.5
    shape = -(-len(at) // _LOOKUP_WIDTH), _LOOKUP_WIDTH  # cv2 takes images, no lists
    x = np.resize(at[:, 0], shape).astype(np.float32)
    y = np.resize(at[:, 1], shape).astype(np.float32)
    found = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return found.reshape(-1, 3)[: len(at)]
