#!/usr/bin/env bash
# NavPy 1.0, `angle2quat` of arrays of heading, pitch and roll in radians, its default unit: it halves the arrays
# that it is given, in place. Its documentation tells of nothing but the returned quaternions. Numbers and
# degrees stay as they are. (`angle2dcm` of the same arrays leaves them alone.)
# Expected: unchanged angles. Seen: the quaternions are right, the caller's angles are half of what they were;
# the next conversion of them gives a heading of 20 degrees for one of 40, the third 10, and any matrix of them
# afterwards is another rotation than the quaternions, by up to 60 degrees here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet navpy==1.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import navpy
import numpy as np
from scipy.spatial.transform import Rotation

DEGREES = np.array([[40.0, 10.0, 5.0], [-120.0, 20.0, -8.0]])
true = Rotation.from_euler("ZYX", DEGREES, degrees=True)

def rotations(quaternions):
    scalars, vectors = quaternions
    return Rotation.from_quat(np.column_stack([vectors, scalars]))

angles = list(np.radians(DEGREES).T.copy())
for call in (1, 2, 3):
    turned = rotations(navpy.angle2quat(*angles))
    off = np.degrees((turned * true.inv()).magnitude())
    print(f"call {call}: heading {turned.as_euler('ZYX', degrees=True)[0, 0]:.1f} degrees, off by {off.round(1)}; "
          f"the angles are {np.degrees(angles).T.round(2).tolist()} now")
    assert (off.max() < 1e-9) == (call == 1)
    assert np.allclose(np.degrees(angles).T, DEGREES / 2**call)

angles = list(np.radians(DEGREES).T.copy())
navpy.angle2quat(*angles)
matrices = np.array([navpy.angle2dcm(*one).T for one in np.transpose(angles)])
off = np.degrees((Rotation.from_matrix(matrices) * true.inv()).magnitude())
print("matrices of the same angles afterwards are off by", off.round(1), "degrees")
assert off.max() > 50
angles = list(DEGREES.T.copy())
navpy.angle2quat(*angles, input_unit="deg")
assert np.array_equal(np.transpose(angles), DEGREES)
PROGRAM
