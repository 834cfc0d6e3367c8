#!/usr/bin/env bash
# Open3D 0.20.0: PLY files with 16-bit colours, as scanners' software writes them. Colours of a point
# cloud are from 0 to 1. `open3d.io.read_point_cloud` divides by 255 what goes up to 65535;
# `open3d.t.io.read_point_cloud` leaves colours out.
# Expected: white is 1, 1, 1. Seen: 257, 257, 257 without a warning, and no colours.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet open3d==0.20.0 numpy==2.4.6
"$work/venv/bin/python" - "$work/white.ply" <<'PROGRAM'
import sys
from pathlib import Path

import numpy as np
import open3d

path = sys.argv[1]
axes = [f"property float {name}" for name in "xyz"]
colours = [f"property ushort {name}" for name in ("red", "green", "blue")]
header = ["ply", "format ascii 1.0", "element vertex 1", *axes, *colours, "end_header"]
Path(path).write_text("\n".join([*header, "0 0 0 65535 65535 65535", ""]))
legacy = np.asarray(open3d.io.read_point_cloud(path).colors)
tensors = open3d.t.io.read_point_cloud(path).point
print(f"white is {legacy}; the tensor reader found {list(tensors)}")
assert np.allclose(legacy, 257), legacy
assert "colors" not in tensors
PROGRAM
