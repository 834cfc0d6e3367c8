#!/usr/bin/env bash
# gsplat 1.5.3, `export_splats`: it leaves out splats with values that are not finite. For the opacities it asks
# whether any splat has such a value, and then leaves out all of them. Opacities are logits here: that of a fully
# opaque splat, an opacity of 1, is infinite.
# Expected of 1000 splats of which one has a logit of infinity: a file of 999, as for an infinite scale. Seen: a
# valid PLY file of 0 splats, without a warning.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 gsplat==1.5.3 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import re

import torch
from gsplat.exporter import export_splats

COUNT = 1000

def splats(opacity, scale):
    """Splats of which number 5 has these values."""
    torch.manual_seed(0)
    opacities, scales = torch.logit(torch.rand(COUNT)), torch.randn(COUNT, 3) - 5
    opacities[5], scales[5, 0] = torch.logit(torch.tensor(opacity)), scale
    quaternions = torch.nn.functional.normalize(torch.randn(COUNT, 4), dim=1)
    return dict(means=torch.randn(COUNT, 3), scales=scales, quats=quaternions, opacities=opacities,
                sh0=torch.randn(COUNT, 1, 3), shN=torch.randn(COUNT, 3, 3))

for name, opacity, scale, expected in (("all are finite", 0.999, -5.0, COUNT),
                                       ("one scale is infinite", 0.999, float("inf"), COUNT - 1),
                                       ("one opacity is 1", 1.0, -5.0, 0)):
    header = export_splats(**splats(opacity, scale), format="ply").split(b"end_header")[0].decode()
    written = int(re.search(r"element vertex (\d+)", header)[1])
    print(f"{name}: {written} of {COUNT} splats in the file")
    assert written == expected, (name, written)
PROGRAM
