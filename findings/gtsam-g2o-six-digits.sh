#!/usr/bin/env bash
# GTSAM 4.3.0, `writeG2o`, the file by which pose graphs go from one program to another: all numbers have
# six significant digits. Of poses in UTM or other coordinates far from the origin little is left.
# Expected of a walk of ten steps of half a metre from 500012.25, 5200004.25: steps of half a metre.
# Seen: the northings are 5.2e+06 or 5.20001e+06: the walk stands still, jumps by 10 m and stands still
# again, which is 304 sigmas of 1 cm for each of the edges in the same file; from the origin it is right.
# Neither writeG2o nor readG2o warns.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet gtsam==4.3.0 numpy==2.4.6
cd "$work"
"$work/venv/bin/python" - <<'PROGRAM'
import gtsam
import numpy as np

START, STEP = np.array([500012.25, 5200004.25, 400.125]), np.array([0.0, 0.5, 0.0])

def saved(start):
    """The northings, and the residual, of a walk to the north that was written and read."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number in range(11):
        values.insert(number, gtsam.Pose3(gtsam.Rot3(), start + number * STEP))
        if number:
            noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)
            graph.add(gtsam.BetweenFactorPose3(number - 1, number, gtsam.Pose3(gtsam.Rot3(), STEP), noise))
    assert graph.error(values) < 1e-9
    gtsam.writeG2o(graph, values, "walk.g2o")
    graph, values = gtsam.readG2o("walk.g2o", True)
    sigmas = np.sqrt(2 * graph.error(values) / 10)
    return np.array([values.atPose3(number).translation()[1] for number in range(11)]), sigmas

for start in (np.zeros(3), START):
    northings, sigmas = saved(start)
    off = northings - (start + np.outer(np.arange(11), STEP))[:, 1]
    print(f"walk from {start}: northings off by {abs(off).min():.2f} to {abs(off).max():.2f} m, steps of "
          f"{np.diff(northings).min():.2f} to {np.diff(northings).max():.2f} m, "
          f"edges off by {sigmas:.0f} sigmas each")
    if start.any():
        assert set(np.diff(northings)) == {0, 10} and sigmas > 100, (off, sigmas)
    else:
        assert abs(off).max() < 1e-9 and sigmas < 1e-6, (off, sigmas)
PROGRAM
