#!/usr/bin/env bash
# laspy 2.7.0, `LasData.change_scaling`, a finer scale for the coordinates of a point cloud: they are integers
# of 32 bits times the scale, and what does not fit is not refused, though an assignment of the same coordinates
# is (OverflowError). Northings of UTM in millimetres without an offset need 33 bits.
# Expected of points in centimetres without an offset, the default of laspy: the same places in millimetres,
# or an error. Seen: all northings are one, thousands of kilometres away, in memory and in the file that is
# written; eastings are right. NumPy alone warns of "invalid value encountered in cast", once in a process.
# `header.scales = ...` before `write` does the same.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet laspy==2.7.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
import warnings

import laspy
import numpy as np

points = np.random.default_rng(0).uniform(-50, 50, (1000, 3)) + (500012, 5200004, 100)
MILLIMETRES = [0.001, 0.001, 0.001]

def cloud():
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.xyz = points
    assert abs(cloud.xyz - points).max() < 0.0051, "stored in centimetres"
    return cloud

changed, by_header = cloud(), cloud()
with warnings.catch_warnings(record=True) as heard:
    changed.change_scaling(scales=MILLIMETRES)
    changed.write("changed.las")
    by_header.header.scales = MILLIMETRES
    by_header.write("by_header.las")
print("warnings:", sorted({str(warning.message) for warning in heard}))
for name, seen in (("in memory", changed), ("written", laspy.read("changed.las")),
                   ("by the header", laspy.read("by_header.las"))):
    off, northings = abs(seen.xyz - points).max(0), len(np.unique(seen.y))
    print(f"{name}: off by up to {off.round(3)} m, {northings} northings of {len(points)} points")
    assert off[0] < 0.011 and off[1] > 1e6 and northings == 1, (off, northings)

fine = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
fine.header.scales = MILLIMETRES
try:
    fine.y = points[:, 1]
except OverflowError as error:
    print("assigned:", error)
else:
    raise AssertionError("an assignment of the same northings was accepted")
PROGRAM
