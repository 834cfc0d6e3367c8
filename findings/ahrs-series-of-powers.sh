#!/usr/bin/env bash
# AHRS 0.4.0, `AngularRate(method="series", order=n)`, the orientation of integrated gyro rates: its terms
# are documented as powers of a 4x4 matrix, and are computed as powers of the matrix's elements. Only the
# first order is right: from the second on, where the error should vanish, it grows.
# Expected of a constant rate of 4.6 rad/s for a second at 100 Hz, against the exact rotation: errors of
# .05 and .02 degrees at orders 1 and 2, and of less than 1e-5 from order 3 on, as exact powers give.
# Seen: .05 degrees at order 1, .84 at order 2, .85 at orders 3 to 5; at 30 Hz .5 and 2.7.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet ahrs==0.4.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import math
import numpy as np
from ahrs.filters import AngularRate
from scipy.spatial.transform import Rotation

RATE = np.array([1.0, 2.0, -4.0])  # rad/s
true = Rotation.from_rotvec(RATE)  # after one second

def off_by(quaternion):
    w, x, y, z = quaternion
    return np.degrees((Rotation.from_quat([x, y, z, w]) * true.inv()).magnitude())

def series(frequency, order):
    """The same steps with powers of the matrix."""
    x, y, z = RATE
    omega = np.array([[0, -x, -y, -z], [x, 0, z, -y], [y, -z, 0, x], [z, y, -x, 0]]) / (2 * frequency)
    step = sum(np.linalg.matrix_power(omega, n) / math.factorial(n) for n in range(order + 1))
    return np.linalg.matrix_power(step, frequency) @ [1, 0, 0, 0]

for frequency in (100, 30):
    rates = np.tile(RATE, (frequency + 1, 1))  # the first one is that of the start
    closed = off_by(AngularRate(rates, frequency=frequency, method="closed").Q[-1])
    assert closed < 1e-9, closed
    errors = {}
    for order in range(1, 6):
        seen = AngularRate(rates, frequency=frequency, method="series", order=order).Q[-1]
        errors[order], exact = off_by(seen), off_by(series(frequency, order))
        print(f"{frequency} Hz, order {order}: off by {errors[order]:.3f} degrees, "
              f"with powers of the matrix by {exact:.1e}")
        assert exact < (0.6 if order == 1 else 0.3) and (order > 1 or np.isclose(exact, errors[1]))
    assert all(errors[order] > 4 * errors[1] for order in range(2, 6)), errors
PROGRAM
