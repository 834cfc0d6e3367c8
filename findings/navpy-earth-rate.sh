#!/usr/bin/env bash
# NavPy 1.0, `earthrate`, the rotation of the earth in north, east and down, which a gyroscope at rest measures:
# the part about the vertical is returned as the one about east, and the vertical has none.
# Expected at a latitude of 45 degrees, in units of 1e-5 rad/s: 5.16, 0, -5.16, as the earth's axis has it in the
# frame of north, east and down. Seen: 5.16, -5.16, 0. A heading by the gyroscope of an instrument at rest that is
# corrected by it turns by 10.6 degrees in an hour, where there would be no drift, and it tilts by as much.
# At the equator it is right. `navrate`, the turn of that frame by a motion, has its parts where they belong.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet navpy==1.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import navpy
import numpy as np

EARTH = 7.292115e-5

for latitude in (-30.0, 0.0, 45.0, 80.0):
    angle = np.radians(latitude)
    north = np.array([-np.sin(angle), 0, np.cos(angle)])
    down = np.array([-np.cos(angle), 0, -np.sin(angle)])
    axes = np.array([north, np.cross(down, north), down])
    right, seen = axes @ (0, 0, EARTH), navpy.earthrate(latitude)
    drift = 3600 * np.degrees(right - seen)
    print(f"latitude {latitude}: {(seen * 1e5).round(2)}, right {(right * 1e5).round(2)} 1e-5 rad/s; "
          f"drift {drift.round(1)} degrees an hour")
    assert np.allclose(seen, [right[0], right[2], 0], atol=1e-10), seen

height, velocity = 100.0, np.array([10.0, 20.0, 0.0])
(east_radius, north_radius), seen = navpy.earthrad(45.0), navpy.navrate(*velocity, 45.0, height)
right = np.array([velocity[1] / east_radius, -velocity[0] / north_radius, -velocity[1] / east_radius])
print(f"navrate {seen}, right {right}")
assert np.allclose(seen, right, rtol=1e-3), seen
PROGRAM
