#!/usr/bin/env bash
# FilterPy 2.0.0, `FixedLagSmoother`, which corrects each of the last N states by every new measurement. It starts
# from the covariance after the measurement where that before it belongs, and carries it back by F - KH where
# F - FKH belongs (both with the K that it has found). `smooth_batch` does the same.
# Expected of fixes of .5 m, one a second, of something that accelerates by .3 m/s2, and a lag of 8: an error of
# .26 m, as a filter of the last nine states finds it, and less than the .40 m of a filter that does not look
# ahead. Seen: .49 m. The smoothed track is worse than the filtered one, at each lag from 1 to 30.
# At ten fixes a second, where the state hardly changes in a step, it is 10 % from the best.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet filterpy==2.0.0 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
from filterpy.kalman import FixedLagSmoother, KalmanFilter

STEPS = 2000
H, R = np.array([[1.0, 0.0]]), np.array([[0.25]])

def started(made, F, Q):
    made.x, made.P, made.F, made.Q, made.H, made.R = np.zeros((2, 1)), np.eye(2) * 0.1, F, Q, H, R
    return made

def errors(step, power, lags):
    """Of positions: of the filter, and by lag of the smoother and of the best estimate with that lag."""
    rng = np.random.default_rng(0)
    F = np.array([[1.0, step], [0.0, 1.0]])
    Q = np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]]) * power
    states = [np.zeros(2)]
    for noise in rng.normal(size=(STEPS, 2)):
        states.append(F @ states[-1] + np.linalg.cholesky(Q) @ noise)
    truth = np.array(states[1:])[:, 0]
    fixes = truth + 0.5 * rng.normal(size=STEPS)

    def rms(places):
        return np.sqrt(np.mean((places - truth)[50 : STEPS - 50] ** 2))

    filtered = started(KalmanFilter(2, 1), F, Q).batch_filter(fixes[:, None, None])[0][:, 0, 0]
    smoothed, best = [], []
    for lag in lags:
        smoother = started(FixedLagSmoother(2, 1, N=lag), F, Q)
        for fix in fixes:
            smoother.smooth(fix)
        smoothed.append(rms(np.array(smoother.xSmooth)[:, 0, 0]))
        # A filter whose state holds this state and the `lag` states before it.
        size = 2 * (lag + 1)
        state, P, carry, noise = np.zeros(size), np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
        P[:2, :2], carry[:2, :2], noise[:2, :2] = np.eye(2) * 0.1, F, Q
        carry[2:, :-2] = np.eye(size - 2)
        places = np.full(STEPS, np.nan)
        for now, fix in enumerate(fixes):
            state, P = carry @ state, carry @ P @ carry.T + noise
            gain = P[:, 0] / (P[0, 0] + R[0, 0])
            state, P = state + gain * (fix - state[0]), P - np.outer(gain, P[0])
            places[now - lag] = state[-2]
        best.append(rms(places))
    return rms(filtered), np.array(smoothed), np.array(best)

LAGS = (1, 2, 8, 30)
filtered, smoothed, best = errors(1.0, 0.1, LAGS)
print(f"one fix a second: filter {filtered:.2f} m; lags {LAGS}: smoother {smoothed.round(2)}, best {best.round(2)} m")
assert (best < filtered).all() and (smoothed > 1.1 * filtered).all(), smoothed
filtered, smoothed, best = errors(0.1, 1.0, LAGS)
print(f"ten a second: filter {filtered:.2f} m; lags {LAGS}: smoother {smoothed.round(2)}, best {best.round(2)} m")
assert (smoothed[1:] < filtered).all() and smoothed[-1] > 1.05 * best[-1]
PROGRAM
