#!/usr/bin/env bash
# pye57 0.4.19, `write_scan_raw`: coordinates, given as doubles, are written to E57 in single precision,
# whatever they are; there is no parameter for it. A survey's coordinates (UTM, metres) keep steps of .5 m
# to the north and 3 cm to the east, though what is read back are doubles again. (A scan near its own
# origin with its place as `translation` keeps its millimetres.)
# Expected of a flat wall of points a centimetre apart at UTM coordinates: the same. Seen: northings
# off by up to .25 m, 201 of them become 5, without a warning; with the place as translation .06 um.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pye57==0.4.19 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import pye57

AXES = ("cartesianX", "cartesianY", "cartesianZ")
place = np.array([500012.25, 5200004.25, 400.125])
wall = np.array([[0.0, 0.01 * n, 0.01 * m] for n in range(201) for m in range(50)])

def read_back(points, translation):
    """The points of a scan that was written and read."""
    file = pye57.E57("wall.e57", mode="w")
    file.write_scan_raw(dict(zip(AXES, points.T)), translation=translation)
    file.close()
    file = pye57.E57("wall.e57")
    scan = file.read_scan(0, ignore_missing_fields=True)
    file.close()
    return np.column_stack([scan[axis] for axis in AXES])

for name, points, translation in (("points at UTM coordinates", wall + place, np.zeros(3)),
                                  ("points from their own origin", wall, place)):
    seen = read_back(points, translation)
    assert seen.dtype == np.float64
    off = abs(seen - (wall + place)).max(0)
    northings = len(np.unique(seen[:, 1].round(4)))
    print(f"{name}: off by up to {off} m, {northings} northings of 201")
    assert (off[1] > 0.2 and northings < 10) == (translation is not place), off
    assert translation is not place or off.max() < 1e-5, off
PROGRAM
