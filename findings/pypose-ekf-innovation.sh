#!/usr/bin/env bash
# PyPose 0.9.5, `pp.module.EKF`: its documentation corrects the predicted state by the measurement less the one
# that the predicted state would give, y - h(x-). It subtracts that of the state before the prediction, h(x). A
# filter of positions of something that moves takes its own motion for an error of the prediction, at every step.
# `pp.module.PF` compares particles in the same way.
# Expected of a linear system, where an EKF is a Kalman filter: its numbers. Seen of a walk at 1.4 m/s with a fix
# of .5 m each second: 1.4 m ahead of the truth on average (Kalman: .01), with a claimed sigma of .34 m. Something
# that stands still is right. (The example in the documentation gives each step the measurement of the state
# before it. Then the error is hardly larger than the best, .49 m, and the claim is still .34 m.)
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 pypose==0.9.5 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import pypose as pp
import torch

torch.manual_seed(0)
torch.set_default_dtype(torch.float64)
F, H = torch.tensor([[1.0, 1.0], [0.0, 1.0]]), torch.tensor([[1.0, 0.0]])
Q, R = torch.tensor([[1 / 3, 1 / 2], [1 / 2, 1.0]]) * 0.01, torch.tensor([[0.25]])

class Walk(pp.module.NLS):
    def state_transition(self, state, input, t=None):
        return state @ F.mT + input

    def observation(self, state, input, t=None):
        return state @ H.mT

def kalman(x, y, u, P):
    x, P = F @ x + u, F @ P @ F.mT + Q
    gain = P @ H.mT / (H @ P @ H.mT + R)
    return x + gain @ (y - H @ x), P - gain @ H @ P

def bias(step, speed):
    """Mean of the filtered positions less the true ones, and the last claimed sigma."""
    state, P = torch.tensor([0.0, speed]), 0.1 * torch.eye(2)
    truth, fixes = state, []
    for noise in torch.randn(200, 3, generator=torch.Generator().manual_seed(1)):
        truth = F @ truth + speed / 1.4 * torch.linalg.cholesky(Q) @ noise[:2]
        state, P = step(state, H @ truth + 0.5 * noise[2:], torch.zeros(2), P)
        fixes.append(state[0] - truth[0])
    return float(sum(fixes) / 200), float(P[0, 0].sqrt())

assert "\\mathbf{h}(\\mathbf{x}^{-}" in pp.module.EKF.__doc__
ekf = pp.module.EKF(Walk(), Q, R)
for name, speed in (("walking", 1.4), ("standing", 0.0)):
    (right, sigma), (seen, claimed) = bias(kalman, speed), bias(ekf, speed)
    print(f"{name}: mean error by the Kalman filter {right:.2f} m, by EKF {seen:.2f} m, sigma {claimed:.2f} m")
    assert abs(right) < 0.15 and abs(claimed - sigma) < 1e-9
    assert abs(seen) > 0.8 if speed else abs(seen) < 0.15, seen
PROGRAM
