#!/usr/bin/env bash
# nerfstudio 1.1.5, `ns-process-data images --camera-type equirectangular`: the views that it cuts from
# a panorama for COLMAP and the training have a dark line where the panorama's ends meet. Its border
# mode "wrap" wraps places alone; grid_sample's cubic kernel takes zeros for pixels past either end.
# The first view looks at the seam: with an even width its middle column lies exactly on it.
# Expected of a panorama of one grey, 200: views of that grey. Seen: 100 in the whole middle column of
# the first view, and such a line in 5 of the 8 views: two of them look up or down the other way, and
# see the seam past the pole.
# The functions are run as the package holds them, without its other dependencies.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 numpy==2.4.6
"$work/venv/bin/pip" install --quiet --no-deps nerfstudio==1.1.5
"$work/venv/bin/python" -W ignore::UserWarning - <<'PROGRAM'
import ast
import importlib.util
from pathlib import Path

import numpy as np
import torch

package = Path(importlib.util.find_spec("nerfstudio").submodule_search_locations[0])
source = package / "process_data/equirect_utils.py"
names = {"np": np, "torch": torch}
wanted = ("euler_rodriguez_rotation_matrix", "remap_cubic", "equirect2persp")
parts = [n for n in ast.parse(source.read_text()).body if getattr(n, "name", None) in wanted]
exec(compile(ast.Module(parts, []), str(source), "exec"), names)

SIZE, FIELD = 512, 120  # pixels and degrees
panorama = torch.full((1, 3, 1024, 2048), 200 / 255)
level = [(yaw, 0) for yaw in range(-180, 180, 90)]  # as generate_planar_projections... has them
steep = [(yaw, pitch) for pitch in (45, -45) for yaw in (-180, 0)]
lines = 0
for yaw, pitch in level + steep:
    view = 255 * names["equirect2persp"](panorama, FIELD, yaw, pitch, SIZE, SIZE)[0, 0].numpy()
    dark = view < 199
    lines += dark.any()
    columns = np.unique(np.nonzero(dark)[1]).tolist()
    print(f"yaw {yaw}, pitch {pitch}: {dark.sum()} dark pixels in {columns}, down to {view.min():.0f}")
    if (yaw, pitch) == (-180, 0):
        assert columns == [SIZE // 2] and dark.sum() == SIZE, columns
        assert np.allclose(view[:, SIZE // 2], 100, atol=0.01), view[:, SIZE // 2]
assert lines == 5, lines
PROGRAM
