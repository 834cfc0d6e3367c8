#!/usr/bin/env bash
# pyquaternion 0.9.9, `Quaternion.yaw_pitch_roll`: its documentation calls the angles "intrinsic Tait-Bryan
# angles following the z-y'-x'' convention", that of vehicles (heading first). They are those of
# x-y'-z'': the roll comes first (the matrix that the same text gives, R_x R_y R_z, is of that kind).
# Expected of heading 40, pitch 20 and roll 10 degrees: these, as SciPy has them for z-y'-x''.
# Seen: 39.2, 21.7 and -5.2, the roll on the other side; a level camera that only turns is right.
# At a pitch of 80 degrees the heading is off by 35 degrees and the roll by 81.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

def about(axis, degrees):
    return Quaternion(axis=axis, degrees=degrees)

assert "following the z-y'-x'' convention" in Quaternion.yaw_pitch_roll.__doc__
for yaw, pitch, roll in ((40, 0, 0), (40, 20, 10), (40, 80, 10)):
    # Turns about the vehicle's own axes, one after another: z, then the new y, then the new x.
    turned = about([0, 0, 1], yaw) * about([0, 1, 0], pitch) * about([1, 0, 0], roll)
    rotation = Rotation.from_matrix(turned.rotation_matrix)
    by_scipy = rotation.as_euler("ZYX", degrees=True)
    seen = np.degrees(turned.yaw_pitch_roll)
    print(f"heading, pitch, roll {yaw, pitch, roll}: SciPy {by_scipy.round(1)}, "
          f"pyquaternion {seen.round(1)}")
    assert np.allclose(by_scipy, [yaw, pitch, roll])
    assert np.allclose(seen, rotation.as_euler("XYZ", degrees=True)[::-1]), seen
    assert np.allclose(seen, by_scipy) == (pitch == 0), seen
PROGRAM
