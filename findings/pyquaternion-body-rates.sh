#!/usr/bin/env bash
# pyquaternion 0.9.9, `Quaternion.integrate` and `derivative`: the rates are documented to be "about the
# global x, y and z axes respectively", and are taken about the axes of the body itself, which is what a
# gyroscope measures. Rates about the world's axes, or a gyroscope's turned into the world first as the
# documentation asks for, give another rotation, without a warning.
# Expected of one second at a constant rate about the world's axes from heading 40, pitch 20, roll 10
# degrees: the rotation of that vector times the start, as numpy-quaternion integrates it.
# Seen: the start times that rotation, 68 degrees away; from the identity both are the same.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pyquaternion==0.9.9 numpy-quaternion==2024.0.13 numpy==2.4.6 \
  scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import quaternion
from pyquaternion import Quaternion
from scipy.spatial.transform import Rotation

RATE, STEPS = np.array([0.5, 1.0, -2.0]), 1000  # rad/s, for one second
for method in (Quaternion.integrate, Quaternion.derivative):
    assert "global x, y and z axes" in " ".join(method.__doc__.split()), method.__doc__

def off_by(rotation, wanted):
    return np.degrees((rotation * wanted.inv()).magnitude())

for angles in ([0, 0, 0], [40, 20, 10]):
    start = Rotation.from_euler("ZYX", angles, degrees=True)
    x, y, z, w = start.as_quat()
    world, body = Rotation.from_rotvec(RATE) * start, start * Rotation.from_rotvec(RATE)

    turned = Quaternion(w, x, y, z)
    for _ in range(STEPS):
        turned.integrate(RATE, 1 / STEPS)
    turned = Rotation.from_matrix(turned.rotation_matrix)
    slope = Quaternion(w, x, y, z).derivative(RATE).elements
    pure = np.array([0, *start.apply(RATE)])  # the body's rates about the world's axes

    _, others = quaternion.integrate_angular_velocity(
        lambda time, rotor: RATE, 0, 1, R0=quaternion.quaternion(w, x, y, z))
    other = Rotation.from_matrix(quaternion.as_rotation_matrix(others[-1]))
    print(f"from {angles} degrees, off from rates about the axes of the world and of the body: pyquaternion "
          f"{off_by(turned, world):.2f} and {off_by(turned, body):.2f} degrees, numpy-quaternion "
          f"{off_by(other, world):.2f} and {off_by(other, body):.2f}")
    assert np.allclose(slope, (0.5 * Quaternion(pure) * Quaternion(w, x, y, z)).elements), slope
    assert off_by(turned, body) < 1e-6 and off_by(other, world) < 1e-6
    assert off_by(turned, world) > 60 if any(angles) else off_by(turned, world) < 1e-6
PROGRAM
