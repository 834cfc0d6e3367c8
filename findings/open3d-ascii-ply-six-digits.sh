#!/usr/bin/env bash
# Open3D 0.20.0, PLY by write_ascii=True: the header says `property double`, and numbers have six
# significant digits, from `open3d.io` as from `open3d.t.io`. As binary, and as text in XYZ and PCD
# files, coordinates of surveys (UTM, metres) keep their millimetres.
# Expected of a point at 500012.25, 5200004.25: that. Seen: 500012, 5200000, four metres away, without
# a warning: points within ten metres of one another lie on one or two lines.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet open3d==0.20.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
from pathlib import Path

import numpy as np
import open3d

places = np.random.default_rng(0).uniform(0, 10, (1000, 3)) + [500000, 5200000, 400]
places[0] = [500012.25, 5200004.25, 405.25]
legacy = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(places))
tensors = open3d.t.geometry.PointCloud(open3d.core.Tensor(places))

def apart(name, io, cloud, text):
    """Largest distance between the points and those of a file of them, in metres."""
    assert io.write_point_cloud(name, cloud, write_ascii=text)
    back = np.asarray(open3d.io.read_point_cloud(name).points)
    return np.linalg.norm(back - places, axis=1).max()

for name, io, cloud in (("legacy.ply", open3d.io, legacy), ("tensor.ply", open3d.t.io, tensors)):
    assert apart(name, io, cloud, text=False) == 0
    error = apart(name, io, cloud, text=True)
    head, _, lines = Path(name).read_text().partition("end_header\n")
    lines = lines.splitlines()
    rows = {line.split()[1] for line in lines}
    print(f"{name} as text: {error:.2f} m off, the first point is at {lines[0]}; all y: {rows}")
    assert "property double x" in head
    assert lines[0].split()[:2] == ["500012", "5.2e+06"], lines[0]
    assert len(rows) <= 2 and 4 < error < 6, (rows, error)
for name in ("legacy.xyz", "legacy.pcd"):
    error = apart(name, open3d.io, legacy, text=True)
    print(f"{name} as text: {error:.0e} m off")
    assert error < 1e-3, error
PROGRAM
