#!/usr/bin/env bash
# GTSAM 4.3.0, Marginals: where a prior holds one direction of a variable exactly (one sigma of its
# diagonal noise model is zero, as of a camera that stays at one height), the marginal covariance of
# the whole variable is zero. Expected of a point with sigmas 1, 2 and 0: variances 1, 4 and 0.
# Seen: 0, 0 and 0, without a word, while the variable that hangs on it by a factor of sigma 1 has
# the right ones, 2, 5 and 1.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet gtsam==4.3.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import gtsam
import numpy as np

noise = gtsam.noiseModel
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
for key in (0, 1):
    values.insert(key, np.zeros(3))
graph.add(gtsam.PriorFactorPoint3(0, np.zeros(3), noise.Diagonal.Sigmas(np.array([1.0, 2.0, 0.0]))))
graph.add(gtsam.BetweenFactorPoint3(0, 1, np.zeros(3), noise.Isotropic.Sigma(3, 1.0)))
marginals = gtsam.Marginals(graph, values)
held, free = (np.diag(marginals.marginalCovariance(key)) for key in (0, 1))
print(f"variances of the held point {held}, of the one tied to it {free}")
assert np.allclose(free, [2, 5, 1]), free
assert np.allclose(held, 0), held
PROGRAM
