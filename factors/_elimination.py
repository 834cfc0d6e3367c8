"""Compiled passes over ranges of landmarks: eliminate, back-substitute and polish, residuals.

Observations are sorted by landmark, then frame; `offsets (J + 1,)` bounds the rows of a landmark.
Each pass writes to arrays of its own, so ranges run in parallel threads without races.
"""

import numpy as np
from numba import njit

from factors._kernels import (
    add_point_hessian,
    invert_symmetric,
    point_normal_equations,
    rig_vector,
    times_symmetric,
    whitened_residual,
)
from factors.robust import rho_and_weight


@njit(cache=True, nogil=True)
def _pose_row(j0, j1, j2, dx, dy, dz, out):
    """Row of d r / d pose from a row of d r / d d: d = world_R_rig^T (X - t), right perturbed."""
    out[0] = j1 * dz - j2 * dy
    out[1] = j2 * dx - j0 * dz
    out[2] = j0 * dy - j1 * dx
    out[3] = -j0
    out[4] = -j1
    out[5] = -j2


@njit(cache=True, nogil=True)
def eliminate_range(
    first, last, obs, points, poses, row_starts, columns, diagonal, off_diagonal, gradient, costs,
    point_costs,
):  # fmt: skip
    """Add landmarks first..last, eliminated, to a reduced pose system.

    Args:
        row_starts (F + 1,), columns (P,): covisible frame pairs i < k as sorted CSR rows.
        diagonal (F, 6, 6), off_diagonal (P, 6, 6), gradient (F, 6), costs (T,): accumulated.
        point_costs (J,): written for the range.
    """
    longest = 0
    for j in range(first, last):
        longest = max(longest, obs.offsets[j + 1] - obs.offsets[j])
    seen = np.empty(longest, np.int64)
    W = np.empty((longest, 6, 3))
    Y = np.empty((longest, 6, 3))
    a, b = np.empty(6), np.empty(6)
    normal = np.empty(9)
    for j in range(first, last):
        point = points[j]
        normal[:] = 0.0
        num, previous, cost = 0, -1, 0.0
        for o in range(obs.offsets[j], obs.offsets[j + 1]):
            f = obs.frames[o]
            if f != previous:
                seen[num], previous = f, f
                W[num] = 0.0
                num += 1
            pose = poses[f]
            dx, dy, dz = rig_vector(pose, point)
            valid, r0, r1, a0, a1, a2, b0, b1, b2 = whitened_residual(obs, o, dx, dy, dz)
            rho, w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)
            costs[obs.families[o]] += rho
            cost += rho
            if not valid:
                continue
            _pose_row(a0, a1, a2, dx, dy, dz, a)
            _pose_row(b0, b1, b2, dx, dy, dz, b)
            H, g, Wf = diagonal[f], gradient[f], W[num - 1]
            for c in range(3):
                p = a0 * pose[3 * c] + a1 * pose[3 * c + 1] + a2 * pose[3 * c + 2]
                q = b0 * pose[3 * c] + b1 * pose[3 * c + 1] + b2 * pose[3 * c + 2]
                normal[6 + c] += w * (p * r0 + q * r1)
                for i in range(6):
                    Wf[i, c] += w * (a[i] * p + b[i] * q)
            for i in range(6):
                ai, bi = w * a[i], w * b[i]
                g[i] += ai * r0 + bi * r1
                for c in range(6):
                    H[i, c] += ai * a[c] + bi * b[c]
            add_point_hessian(normal, pose, a0, a1, a2, b0, b1, b2, w)
        point_costs[j] = cost
        inverse = invert_symmetric(normal)
        for i in range(num):
            f = seen[i]
            H, g = diagonal[f], gradient[f]
            Wi, Yi = W[i], Y[i]
            for r in range(6):
                y0, y1, y2 = times_symmetric(inverse, Wi[r, 0], Wi[r, 1], Wi[r, 2])
                Yi[r, 0], Yi[r, 1], Yi[r, 2] = y0, y1, y2
                g[r] -= y0 * normal[6] + y1 * normal[7] + y2 * normal[8]
                for c in range(6):
                    H[r, c] -= y0 * Wi[c, 0] + y1 * Wi[c, 1] + y2 * Wi[c, 2]
            slot = row_starts[f]
            for k in range(i + 1, num):
                while columns[slot] != seen[k]:
                    slot += 1
                B, Wk = off_diagonal[slot], W[k]
                for r in range(6):
                    y0, y1, y2 = Yi[r, 0], Yi[r, 1], Yi[r, 2]
                    for c in range(6):
                        B[r, c] -= y0 * Wk[c, 0] + y1 * Wk[c, 1] + y2 * Wk[c, 2]


@njit(cache=True, nogil=True)
def _substituted_step(obs, j, point, poses, steps, normal):
    """Gauss-Newton step of landmark j that goes with the pose steps (F, 6)."""
    normal[:] = 0.0
    a, b = np.empty(6), np.empty(6)
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        f = obs.frames[o]
        pose, step = poses[f], steps[f]
        dx, dy, dz = rig_vector(pose, point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = whitened_residual(obs, o, dx, dy, dz)
        if not valid:
            continue
        w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)[1]
        _pose_row(a0, a1, a2, dx, dy, dz, a)
        _pose_row(b0, b1, b2, dx, dy, dz, b)
        for i in range(6):
            r0 += a[i] * step[i]
            r1 += b[i] * step[i]
        add_point_hessian(normal, pose, a0, a1, a2, b0, b1, b2, w)
        for c in range(3):
            p = a0 * pose[3 * c] + a1 * pose[3 * c + 1] + a2 * pose[3 * c + 2]
            q = b0 * pose[3 * c] + b1 * pose[3 * c + 1] + b2 * pose[3 * c + 2]
            normal[6 + c] -= w * (p * r0 + q * r1)
    return times_symmetric(invert_symmetric(normal), normal[6], normal[7], normal[8])


@njit(cache=True, nogil=True)
def polish_range(
    first, last, obs, points, poses, old_poses, steps, substitute, num_steps, point_costs,
    trial_points, trial_costs,
):  # fmt: skip
    """Move landmarks first..last to (near) their optimum at `poses`.

    With `substitute`, they first take the linear step that goes with pose `steps (F, 6)` from
    `old_poses`; where that makes a landmark worse than its old cost, it starts from its old place
    if that is better. Then up to `num_steps` damped Gauss-Newton steps that never raise the cost.
    Writes `trial_points (J, 3)`, `trial_costs (J,)`.
    """
    normal, candidate_normal = np.empty(9), np.empty(9)
    here, there = np.empty(3), np.empty(3)
    for j in range(first, last):
        here[:] = points[j]
        if substitute:
            x, y, z = _substituted_step(obs, j, here, old_poses, steps, normal)
            here[0] += x
            here[1] += y
            here[2] += z
        cost = point_normal_equations(obs, j, here, poses, normal)
        if substitute and not cost <= point_costs[j]:
            there[:] = points[j]
            stay = point_normal_equations(obs, j, there, poses, candidate_normal)
            if not cost <= stay:
                here[:] = there
                normal[:] = candidate_normal
                cost = stay
        damping = 0.0
        for _ in range(num_steps):
            extra = damping * (normal[0] + normal[3] + normal[5])
            normal[0] += extra
            normal[3] += extra
            normal[5] += extra
            x, y, z = times_symmetric(invert_symmetric(normal), normal[6], normal[7], normal[8])
            gain = 0.5 * (x * normal[6] + y * normal[7] + z * normal[8])
            if not gain > 1e-6 * cost:
                break
            there[0], there[1], there[2] = here[0] - x, here[1] - y, here[2] - z
            trial = point_normal_equations(obs, j, there, poses, candidate_normal)
            if trial < cost:
                here[:] = there
                normal[:] = candidate_normal
                cost = trial
                damping *= 0.1
            else:
                damping = max(1e-3, 10.0 * damping)
        trial_points[j] = here
        trial_costs[j] = cost


@njit(cache=True, nogil=True)
def residuals_range(first, last, obs, points, poses, residuals, valid):
    """Write the whitened residuals (O, 2) and validity (O,) of landmarks first..last."""
    for j in range(first, last):
        for o in range(obs.offsets[j], obs.offsets[j + 1]):
            dx, dy, dz = rig_vector(poses[obs.frames[o]], points[j])
            result = whitened_residual(obs, o, dx, dy, dz)
            valid[o] = result[0]
            residuals[o, 0] = result[1]
            residuals[o, 1] = result[2]
