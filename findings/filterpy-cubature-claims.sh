#!/usr/bin/env bash
# FilterPy 2.0.0, `CubatureKalmanFilter`: the process noise Q is added to the covariance of the prediction, but
# the points that the update goes on with are those from before it. (`UnscentedKalmanFilter` draws its points
# anew.) The measurement therefore takes nothing off Q: all of it is in the covariance after each fix.
# Expected of a linear system, where it is a Kalman filter: its numbers, and never a claim above the sigma of a
# fix. Seen of fixes of .5 m: a claim of .64 m instead of .39 where a walker moves by .5 m in between, and of 5.0
# instead of .50 m where a car moves by 5 m, though the places are off by .40 and .50 m. The claim is P + Q to six
# digits; a weight or a gate by it is wrong by up to a factor of 100 in variance. The unscented filter is right.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet filterpy==2.0.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from filterpy.kalman import CubatureKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

SIGMA = 0.5  # of a fix, m

def same(state, *_):
    return state

def errors(walk):
    """RMS of places on a plane by three filters, and what they claim; fixes of a random walk."""
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(scale=walk, size=(2000, 2)), axis=0)
    fixes = truth + rng.normal(scale=SIGMA, size=truth.shape)
    points = MerweScaledSigmaPoints(2, 0.1, 2, 1)
    filters = {
        "Kalman": KalmanFilter(2, 2),
        "unscented": UnscentedKalmanFilter(2, 2, 1.0, same, same, points),
        "cubature": CubatureKalmanFilter(2, 2, 1.0, same, same),
    }
    result = {}
    for name, made in filters.items():
        made.x, made.P = np.zeros(2), np.eye(2)
        made.Q, made.R = np.eye(2) * walk**2, np.eye(2) * SIGMA**2
        if name == "Kalman":
            made.F, made.H = np.eye(2), np.eye(2)
        if name == "cubature":
            made.x, fixes = made.x[:, None], fixes[..., None]
        off = []
        for fix, place in zip(fixes, truth):
            made.predict()
            made.update(fix)
            off.append(np.ravel(made.x) - place)
        result[name] = np.sqrt(np.mean(np.square(off))), np.sqrt(made.P[0, 0])
    return result

for walk in (0.05, 0.5, 5.0):
    found = errors(walk)
    told = ", ".join(f"{name} {rms:.2f} (claims {claim:.2f}) m" for name, (rms, claim) in found.items())
    print(f"steps of {walk} m: {told}")
    assert np.allclose(found["Kalman"], found["unscented"])
    (best, right), (rms, claim) = found["Kalman"], found["cubature"]
    assert abs(rms - best) < 1e-3 and abs(best - right) < 0.01
    assert abs(claim**2 - right**2 - walk**2) < 1e-6, claim
PROGRAM
