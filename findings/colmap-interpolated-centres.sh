#!/usr/bin/env bash
# COLMAP 4.2 (pycolmap 4.2.1), poses between two poses (`interpolate_camera_poses`,
# `Rigid3d.interpolate`): rotations are interpolated on the sphere, and the translations of
# cam_from_world linearly. These are -R * centre: the camera leaves the line between the two centres,
# the farther the more it turns and the farther away the origin is. In another world frame it takes
# another path.
# Expected of a camera that turns by 90 degrees on the spot: it stays there. Seen: half way it is .29 m
# away at 1 m from the origin and 29 m at 100 m, 1 - cos 45 degrees of the distance.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import pycolmap

def camera(degrees, centre):
    """cam_from_world of a camera at a place, turned about its vertical axis."""
    half = np.deg2rad(degrees) / 2
    turn = pycolmap.Rotation3d([0, np.sin(half), 0, np.cos(half)])
    return pycolmap.Rigid3d(turn, -(turn * centre))

for distance in (0.0, 1.0, 100.0):
    centre = np.array([distance, 0.0, 0.0])
    ends = camera(0, centre), camera(90, centre)
    for between in (pycolmap.interpolate_camera_poses, pycolmap.Rigid3d.interpolate):
        pose = between(*ends, 0.5)
        off = np.linalg.norm(pose.tgt_origin_in_src() - centre)
        turned = np.rad2deg(pose.rotation.angle())
        print(f"{between.__name__}, {distance:.0f} m from the origin: turned by {turned:.1f} degrees, "
              f"{off:.3f} m away from where both ends are")
        assert np.isclose(turned, 45), turned
        assert np.isclose(off, distance * (1 - np.cos(np.pi / 4))), off
# Interpolated as a pose of the camera in the world, it stays.
pose = pycolmap.Rigid3d.interpolate(*(end.inverse() for end in ends), 0.5)
assert np.allclose(pose.translation, centre), pose
PROGRAM
