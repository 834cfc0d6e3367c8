#!/usr/bin/env bash
# transformations 2026.1.18, `rotation_from_matrix`, the angle and axis of a rotation (the module is copied into
# many programs; the copy in trimesh 5.2.0 does the same): the axis is the last eigenvector whose eigenvalue has a
# real part within 1e-8 of one. That holds of all three where the rotation is less than 1.4e-4 rad, .008 degrees,
# as of a gyroscope's step at a kilohertz or two poses of a standing camera; then it is any of them.
# Expected of a matrix turned by less: its angle and axis, as SciPy finds them to 1e-12. Seen of 500 random axes: at
# 2e-4 rad all are right; at 1e-4 rad and below 28 % are off by half the angle and more, one by 300 times it,
# without a warning. The matrices are exact to the last digit.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet transformations==2026.1.18 trimesh==5.2.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import transformations
import trimesh.transformations
from scipy.spatial.transform import Rotation

axes = np.random.default_rng(0).normal(size=(500, 3))
axes /= np.linalg.norm(axes, axis=1, keepdims=True)
for name, module in (("transformations", transformations), ("trimesh", trimesh.transformations)):
    for angle in (2e-4, 1e-4, 1e-5):
        off = []
        for axis in axes:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            found, direction, _ = module.rotation_from_matrix(matrix)
            off.append(np.linalg.norm(found * direction - angle * axis) / angle)
            assert np.allclose(Rotation.from_matrix(matrix[:3, :3]).as_rotvec(), angle * axis, rtol=0, atol=1e-12)
        wrong = np.mean(np.array(off) > 0.5)
        print(f"{name}, {angle:.0e} rad: off by half the angle and more {wrong:.0%}, median error "
              f"{np.median(off):.2g} times the angle, largest {max(off):.2g} times")
        assert wrong == 0 if angle > 1.5e-4 else 0.2 < wrong < 0.4, wrong
PROGRAM
