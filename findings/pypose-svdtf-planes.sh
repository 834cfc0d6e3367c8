#!/usr/bin/env bash
# PyPose 0.9.5, `svdtf`, the rigid transform between two sets of points: where the singular vectors
# give a reflection, it negates the whole matrix, not the direction of the smallest singular value.
# Of points in a plane, as the places of a walk on level ground are, that is every second time.
# Expected: the transform that maps the points on one another exactly, at any pose. Seen: half of 400
# sets of ten coplanar points end metres away (their spread is one metre), without a warning.
# Points that fill space are right.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 pypose==0.9.5 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import pypose
import torch

torch.manual_seed(0)
torch.set_default_dtype(torch.float64)

def worst(flat):
    """Largest distance between mapped points and theirs, of each of 400 sets of ten points."""
    distances = []
    for _ in range(400):
        points = torch.randn(10, 3) * torch.tensor([1.0, 1.0, 0.0 if flat else 1.0])
        points = pypose.randn_SE3().Act(points)
        wanted = pypose.randn_SE3().Act(points)
        distances.append((pypose.svdtf(points, wanted).Act(points) - wanted).norm(dim=-1).max())
    return torch.stack(distances)

for name, flat in (("points that fill space", False), ("points in a plane", True)):
    distances = worst(flat)
    share = (distances > 0.1).double().mean().item()
    print(f"{name}: {share:.0%} of sets off by more than .1 m, at most {distances.max():.1e} m")
    assert distances.max() < 1e-9 if not flat else share > 0.3 and distances.max() > 1, distances
PROGRAM
