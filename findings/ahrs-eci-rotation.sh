#!/usr/bin/env bash
# AHRS 0.4.0, `ahrs.common.frames.eci2ecef(w, t)`, the turn from the inertial to the earth-fixed frame by the rate
# w (rad/s) after t seconds: its matrix has cos(w) * t and sin(w) * t where cos(w * t) and sin(w * t) belong.
# Expected: a rotation about the earth's axis, by 15.04 degrees in an hour. Seen: after one second it is one;
# after an hour it is turned by .004 degrees and makes vectors in the equator's plane 3600 times as long; at t = 0,
# its default, it makes them 0.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from ahrs.common.frames import eci2ecef
from scipy.spatial.transform import Rotation

RATE = 7.292115e-5  # of the earth, rad/s
for seconds in (1.0, 3600.0, 0.0):
    wanted = Rotation.from_rotvec([0, 0, -RATE * seconds]).as_matrix()
    seen = eci2ecef(RATE, seconds)
    longer = np.linalg.norm(seen[:, 0])
    turned = np.degrees(np.arctan2(seen[0, 1], seen[0, 0]))
    print(f"after {seconds:.0f} s: turned by {turned:.4f} degrees (wanted {np.degrees(RATE * seconds):.4f}), "
          f"vectors of the equator's plane are {longer:.0f} times as long")
    assert np.allclose(seen, wanted, atol=1e-12) == (seconds == 1), seen
    assert abs(longer - seconds) < 1e-9 * max(1, seconds)
PROGRAM
