#!/usr/bin/env bash
# Open3D 0.20.0, `ScalableTSDFVolume.integrate`, the fusion of depth images: it opens blocks of voxels where
# the depths divided by 1000 are, though the depth of an RGBDImage is in metres. Only what lies in the
# blocks around the camera's centre is fused. `UniformTSDFVolume` fuses the same images rightly, as
# ScalableTSDFVolume did in 0.19.0, where create_from_depth_image left depths in floats as they are.
# Expected of a wall 2 m ahead: its mesh. Seen with voxels of 2 cm: no vertex, without a warning. With
# voxels of 25 cm, whose blocks of 16 reach 4 m: of level ground seen from 3.6 to 25.6 m ahead and 15 m to
# either side, what is 3.6 to 3.9 m ahead and 2 m to either side.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet open3d==0.20.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import open3d
from open3d.pipelines import integration

WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
camera = open3d.camera.PinholeCameraIntrinsic(WIDTH, HEIGHT, FOCAL, FOCAL, 319.5, 239.5)
colour = open3d.geometry.Image(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
plain = integration.TSDFVolumeColorType.NoColor

def mesh(volume, depth):
    """Vertices of the mesh of one depth image in metres, seen from the origin."""
    image = open3d.geometry.RGBDImage.create_from_color_and_depth(
        colour, open3d.geometry.Image(depth.astype(np.float32)), depth_scale=1.0, depth_trunc=100.0,
        convert_rgb_to_intensity=False)
    assert np.allclose(image.depth, depth)
    volume.integrate(image, camera, np.eye(4))
    return np.asarray(volume.extract_triangle_mesh().vertices)

wall = np.full((HEIGHT, WIDTH), 2.0)
down = (np.arange(HEIGHT) - 239.5) / FOCAL
ground = 1.6 / np.maximum(down, 1e-3)  # depths of level ground 1.6 m below
street = np.tile(np.where(ground < 30, ground, 0)[:, None], WIDTH)

right = mesh(integration.UniformTSDFVolume(4.0, 200, 0.08, plain, origin=[-2, -2, 0]), wall)
seen = mesh(integration.ScalableTSDFVolume(0.02, 0.08, plain), wall)
print(f"a wall at 2 m: {len(right)} vertices by UniformTSDFVolume, {len(seen)} by ScalableTSDFVolume")
assert len(right) > 10000 and np.allclose(right[:, 2], 2, atol=1e-3), len(right)
assert len(seen) == 0, len(seen)

right = mesh(integration.UniformTSDFVolume(40.0, 160, 1.0, plain, origin=[-20, -20, 0]), street)
seen = mesh(integration.ScalableTSDFVolume(0.25, 1.0, plain), street)
for name, vertices in (("UniformTSDFVolume", right), ("ScalableTSDFVolume", seen)):
    print(f"a street of 30 m: from {vertices.min(0).round(1)} to {vertices.max(0).round(1)} m by {name}")
assert right[:, 2].max() > 25, right.max(0)
assert 0 < len(seen) and seen[:, 2].max() < 8, seen.max(0)
PROGRAM
