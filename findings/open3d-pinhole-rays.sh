#!/usr/bin/env bash
# Open3D 0.20.0, `RaycastingScene.create_rays_pinhole`: the ray of pixel u, v goes through u + 1/2,
# v + 1/2 of the intrinsic matrix; its documentation is silent about that. create_from_depth_image and
# project_to_depth_image take u, v as they are, and the intrinsics that Open3D brings along (PrimeSense)
# are of that kind: their principal point is at 319.5, 239.5.
# Expected of depths cast at a mesh by one matrix, as points by the same matrix: points on the mesh.
# Seen of a wall at 45 degrees: all points half a pixel aside, 1.35 mm behind the wall at 2 m; by the
# matrix less half a pixel they are on it, to a thousandth of a millimetre.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet open3d==0.20.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import open3d

WIDTH, HEIGHT = 640, 480
kind = open3d.camera.PinholeCameraIntrinsicParameters.PrimeSenseDefault
matrix = np.array(open3d.camera.PinholeCameraIntrinsic(kind).intrinsic_matrix)
corners = np.array([[x, y, 2 + x] for x in (-1.9, 5) for y in (-5, 5)])  # z = 2 + x, camera at 0
wall = open3d.t.geometry.TriangleMesh(corners.astype(np.float32), np.array([[0, 1, 2], [1, 3, 2]]))
scene = open3d.t.geometry.RaycastingScene()
scene.add_triangles(wall)
pose = open3d.core.Tensor(np.eye(4))

rays = scene.create_rays_pinhole(open3d.core.Tensor(matrix), pose, WIDTH, HEIGHT)
depth = scene.cast_rays(rays)["t_hit"].numpy()  # along z: rays are as long as that z is 1
assert np.allclose(rays.numpy()[..., 5], 1) and np.isfinite(depth).all()

def points(matrix):
    intrinsic = open3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, matrix)
    image = open3d.geometry.Image(depth)
    cloud = open3d.geometry.PointCloud.create_from_depth_image(
        image, intrinsic, np.eye(4), depth_scale=1.0, depth_trunc=100.0
    )
    return np.asarray(cloud.points)

half = np.zeros((3, 3))
half[:2, 2] = 0.5
for name, used, pixels in (("the same matrix", matrix, 0.5), ("less half a pixel", matrix - half, 0)):
    x, _, z = points(used).T
    behind = (z - x - 2) / np.sqrt(2)
    wanted = pixels * z / matrix[0, 0] / np.sqrt(2)
    near = abs(z - 2) < 0.01
    print(f"{name}: points at a depth of 2 m are {1000 * behind[near].mean():.4f} mm behind the wall")
    assert len(z) == WIDTH * HEIGHT and np.allclose(behind, wanted, atol=2e-6), abs(behind - wanted).max()
PROGRAM
