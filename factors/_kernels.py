"""Compiled passes over landmarks: elimination, back-substitution, polishing, residuals.

Poses are rows `(12,)` = `[world_R_rig row-major (9), rig_in_world (3)]`. Each pass handles a range
of landmarks and releases the GIL, so that threads share the work; each thread accumulates into
arrays of its own.
"""

import numpy as np

from factors._observations import BEARING, GIVEN, MIN_DEPTH
from factors.compiled import kernel_and_part
from factors.kernel_parts import (
    MIN_RELATIVE_DAMPING,
    inverse_root,
    invert_symmetric,
    rig_vector,
    squared_root,
    tangent_axes,
    times_symmetric,
)
from factors.landmark_residual import call_residual, has_functions
from factors.robust import rho_and_weight

_EPS = 1e-300  # guards divisions by a squared norm

_kernel, _part = kernel_and_part(fastmath={"contract"})


@_part
def _log_map(x, y, z):
    """Tangent vector at +z pointing to (x, y, z), its length the angle, and its Jacobian.

    r = f (x, y) with f = angle / hypot(x, y); dr = f I + k (x, y)(x, y)^T | -(x, y) / n^2.
    Both have a series where the angle is small, free of cancellation.
    """
    s2 = x * x + y * y
    n2 = s2 + z * z
    if z > 0 and s2 < 0.01 * z * z:
        q = s2 / (z * z)
        f = 1.0 - q * (1 / 3 - q * (1 / 5 - q * (1 / 7 - q * (1 / 9 - q * (1 / 11 - q / 13)))))
        k = 2 / 3 - q * (4 / 5 - q * (6 / 7 - q * (8 / 9 - q * (10 / 11 - q * (12 / 13)))))
        f /= z
        k /= -z * z * z
    else:
        s = np.sqrt(s2)
        angle = np.arctan2(s, z)
        if s2 < 1e-24 * n2:  # opposite: the direction is undefined, and so is its derivative
            return angle, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        f = angle / s
        k = (z / n2 - f) / s2
    return f * x, f * y, f + k * x * x, k * x * y, -x / n2, k * x * y, f + k * y * y, -y / n2


@_part
def whitened_residual(obs, o, dx, dy, dz):
    """Whitened residual and Jacobian of observation o, for its point at d in the rig frame.

    Returns:
        valid, r0, r1, then the Jacobian d r / d d by rows (6 values). A point behind the face, or
        at the centre, is invalid: its Jacobian is zero and its residual a large constant (2 focal
        in u and v as in GTSAM's projection factor; pi), so that it moves nothing and yet no step
        gains by sending points there.
    """
    kind, measurement, whitener = obs.kinds[o], obs.measurements[o], obs.whiteners[o]
    s00, s01, s11 = whitener[0], whitener[1], whitener[2]
    if kind == BEARING:
        mx, my, mz = measurement[0], measurement[1], measurement[2]
        ax, ay, az, bx, by, bz = tangent_axes(mx, my, mz)
    elif has_functions(obs.functions) and kind >= GIVEN:  # type: ignore
        ax, ay, az, bx, by, bz, mx, my, mz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    else:
        camera = obs.cameras[int(measurement[2])]
        ax, bx, mx, ay, by, my = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
        az, bz, mz = camera[6], camera[7], camera[8]
    x = ax * dx + ay * dy + az * dz
    y = bx * dx + by * dy + bz * dz
    z = mx * dx + my * dy + mz * dz
    if kind == BEARING:
        if x * x + y * y + z * z < _EPS:
            return False, s00 * np.pi, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        r0, r1, j00, j01, j02, j10, j11, j12 = _log_map(x, y, z)
    elif has_functions(obs.functions) and kind >= GIVEN:  # type: ignore
        seen, r0, r1, j00, j01, j02, j10, j11, j12 = call_residual(  # type: ignore
            obs.functions, kind - GIVEN, measurement[0], measurement[1], measurement[2], x, y, z
        )
        if seen == 0.0:
            return False, s00 * r0 + s01 * r1, s11 * r1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    else:
        if z * z <= MIN_DEPTH * MIN_DEPTH * (x * x + y * y) or z <= _EPS:
            r0 = r1 = 2.0 * camera[9]
            return False, s00 * r0 + s01 * r1, s11 * r1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        scale = camera[9] / z
        r0 = scale * x + camera[10] - measurement[0]
        r1 = scale * y + camera[11] - measurement[1]
        j00, j01, j02 = scale, 0.0, -scale * x / z
        j10, j11, j12 = 0.0, scale, -scale * y / z
    j00, j01, j02 = s00 * j00 + s01 * j10, s00 * j01 + s01 * j11, s00 * j02 + s01 * j12
    j10, j11, j12 = s11 * j10, s11 * j11, s11 * j12
    return (
        True, s00 * r0 + s01 * r1, s11 * r1,
        j00 * ax + j01 * bx + j02 * mx, j00 * ay + j01 * by + j02 * my,
        j00 * az + j01 * bz + j02 * mz, j10 * ax + j11 * bx + j12 * mx,
        j10 * ay + j11 * by + j12 * my, j10 * az + j11 * bz + j12 * mz,
    )  # fmt: skip


@_part
def _residual_from_rig(obs, o, x, y, z):
    """`whitened_residual` of a point at (x, y, z) relative to the rig's centre, rig frame."""
    origin = obs.origins[o]
    return whitened_residual(obs, o, x - origin[0], y - origin[1], z - origin[2])


@_part
def _add_normal(normal, pose, a0, a1, a2, b0, b1, b2, r0, r1, w):
    """Add to a landmark's Hessian (6) and gradient (3) in `normal`; returns d r / d X by rows."""
    p0 = a0 * pose[0] + a1 * pose[1] + a2 * pose[2]
    p1 = a0 * pose[3] + a1 * pose[4] + a2 * pose[5]
    p2 = a0 * pose[6] + a1 * pose[7] + a2 * pose[8]
    q0 = b0 * pose[0] + b1 * pose[1] + b2 * pose[2]
    q1 = b0 * pose[3] + b1 * pose[4] + b2 * pose[5]
    q2 = b0 * pose[6] + b1 * pose[7] + b2 * pose[8]
    normal[0] += w * (p0 * p0 + q0 * q0)
    normal[1] += w * (p0 * p1 + q0 * q1)
    normal[2] += w * (p0 * p2 + q0 * q2)
    normal[3] += w * (p1 * p1 + q1 * q1)
    normal[4] += w * (p1 * p2 + q1 * q2)
    normal[5] += w * (p2 * p2 + q2 * q2)
    normal[6] += w * (p0 * r0 + q0 * r1)
    normal[7] += w * (p1 * r0 + q1 * r1)
    normal[8] += w * (p2 * r0 + q2 * r1)
    return p0, p1, p2, q0, q1, q2


@_part
def _point_normal(obs, j, point, poses, normal):
    """Cost of landmark j at `point`; its Hessian and gradient go into `normal (9,)`."""
    normal[:] = 0.0
    cost = 0.0
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        pose = poses[obs.frames[o]]
        dx, dy, dz = rig_vector(pose, point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = _residual_from_rig(obs, o, dx, dy, dz)
        rho, w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)
        cost += rho
        if valid:
            _add_normal(normal, pose, a0, a1, a2, b0, b1, b2, r0, r1, w)
    return cost


@_part
def _pose_row(j0, j1, j2, dx, dy, dz, out):
    """Row of d r / d pose from a row of d r / d d: d = world_R_rig^T (X - t), right perturbed."""
    out[0] = j1 * dz - j2 * dy
    out[1] = j2 * dx - j0 * dz
    out[2] = j0 * dy - j1 * dx
    out[3] = -j0
    out[4] = -j1
    out[5] = -j2


@_part
def _take_product(Y, W, B):
    """B -= Y W; the six entries of a row are independent, so that they are vectorised."""
    a0, a1, a2, a3, a4, a5 = W[0, 0], W[0, 1], W[0, 2], W[0, 3], W[0, 4], W[0, 5]
    b0, b1, b2, b3, b4, b5 = W[1, 0], W[1, 1], W[1, 2], W[1, 3], W[1, 4], W[1, 5]
    c0, c1, c2, c3, c4, c5 = W[2, 0], W[2, 1], W[2, 2], W[2, 3], W[2, 4], W[2, 5]
    for r in range(6):
        x, y, z = Y[r, 0], Y[r, 1], Y[r, 2]
        t0 = B[r, 0] - (x * a0 + y * b0 + z * c0)
        t1 = B[r, 1] - (x * a1 + y * b1 + z * c1)
        t2 = B[r, 2] - (x * a2 + y * b2 + z * c2)
        t3 = B[r, 3] - (x * a3 + y * b3 + z * c3)
        t4 = B[r, 4] - (x * a4 + y * b4 + z * c4)
        t5 = B[r, 5] - (x * a5 + y * b5 + z * c5)
        B[r, 0], B[r, 1], B[r, 2], B[r, 3], B[r, 4], B[r, 5] = t0, t1, t2, t3, t4, t5


@_part
def _linearize(
    j, obs, visits, points, poses, W, inverses, roots, shifts, diagonal, gradient, costs, scratch
):  # fmt: skip
    """`linearize_range` of landmark j; returns its cost."""
    a, b, normal = scratch
    point = points[j]
    normal[:] = 0.0
    row = j - visits.first
    visit, previous, cost = visits.offsets[row] - 1, -1, 0.0
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        f = obs.frames[o]
        if f != previous:
            visit, previous = visit + 1, f
            W[visit] = 0.0
        pose = poses[f]
        dx, dy, dz = rig_vector(pose, point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = _residual_from_rig(obs, o, dx, dy, dz)
        rho, w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)
        costs[obs.families[o]] += rho
        cost += rho
        if not valid:
            continue
        _pose_row(a0, a1, a2, dx, dy, dz, a)
        _pose_row(b0, b1, b2, dx, dy, dz, b)
        rows = _add_normal(normal, pose, a0, a1, a2, b0, b1, b2, r0, r1, w)
        H, g, Wf = diagonal[f], gradient[f], W[visit]
        for i in range(6):
            ai, bi = w * a[i], w * b[i]
            g[i] += ai * r0 + bi * r1
            for c in range(3):
                Wf[c, i] += ai * rows[c] + bi * rows[3 + c]
            for c in range(6):
                H[i, c] += ai * a[c] + bi * b[c]
    root = inverse_root(normal, 0.0)
    inverse = squared_root(root)
    for c in range(6):
        roots[row, c], inverses[row, c] = root[c], inverse[c]
    x, y, z = times_symmetric(inverse, normal[6], normal[7], normal[8])
    shifts[row, 0], shifts[row, 1], shifts[row, 2] = x, y, z
    return cost


@_kernel
def linearize_range(
    first, last, obs, visits, points, poses, W, inverses, roots, shifts, diagonal, gradient,
    costs, point_costs,
):  # fmt: skip
    """Add the poses' own part of landmarks first..last, and write the terms that eliminate these.

    Args:
        visits: visits of a run of landmarks that includes these.
        W (V, 3, 6): written, Hessian between landmark and pose of each visit.
        inverses (L, 6), roots (L, 6), shifts (L, 3): written, inverse of each landmark's Hessian,
            the root of the inverse, and the inverse times the gradient.
        diagonal (F, 6, 6), gradient (F, 6), costs (T,): accumulated.
        point_costs (J,): written for the range.
    """
    scratch = np.empty(6), np.empty(6), np.empty(9)
    for j in range(first, last):
        point_costs[j] = _linearize(
            j, obs, visits, points, poses, W, inverses, roots, shifts, diagonal, gradient, costs,
            scratch,
        )  # fmt: skip


@_part
def _eliminate_row(
    f, visits, W, inverses, shifts, row_starts, columns, diagonal, off_diagonal, gradient, slots, Y
):  # fmt: skip
    """`eliminate_rows` of frame f."""
    H, g = diagonal[f], gradient[f]
    for slot in range(row_starts[f], row_starts[f + 1]):
        slots[columns[slot]] = slot
    for e in range(visits.row_offsets[f], visits.row_offsets[f + 1]):
        visit = visits.by_frame[e]
        j = visits.owners[visit]
        inverse, shift, Wf = inverses[j], shifts[j], W[visit]
        for r in range(6):
            g[r] -= Wf[0, r] * shift[0] + Wf[1, r] * shift[1] + Wf[2, r] * shift[2]
            Y[r, 0], Y[r, 1], Y[r, 2] = times_symmetric(inverse, Wf[0, r], Wf[1, r], Wf[2, r])
        _take_product(Y, Wf, H)
        for k in range(visit + 1, visits.offsets[j + 1]):
            _take_product(Y, W[k], off_diagonal[slots[visits.frames[k]]])


@_kernel
def eliminate_rows(
    first, last, visits, W, inverses, shifts, row_starts, columns, diagonal, off_diagonal, gradient
):  # fmt: skip
    """Subtract the landmarks' Schur complement from the rows of frames first..last.

    Row by row, so that each sum has a fixed order and its blocks stay in the cache.

    Args:
        row_starts (F + 1,), columns (P,): covisible frame pairs i < k as sorted CSR rows.
        diagonal (F, 6, 6), off_diagonal (P, 6, 6), gradient (F, 6): accumulated.
    """
    slots = np.empty(len(diagonal), np.int64)
    Y = np.empty((6, 3))
    for f in range(first, last):
        if visits.row_offsets[f] == visits.row_offsets[f + 1]:
            continue
        _eliminate_row(
            f, visits, W, inverses, shifts, row_starts, columns, diagonal, off_diagonal, gradient,
            slots, Y,
        )  # fmt: skip


@_part
def _substituted_step(obs, j, point, poses, steps, normal):
    """Negated Gauss-Newton step of landmark j, given the pose steps (F, 6)."""
    normal[:] = 0.0
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        pose, step = poses[obs.frames[o]], steps[obs.frames[o]]
        dx, dy, dz = rig_vector(pose, point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = _residual_from_rig(obs, o, dx, dy, dz)
        if not valid:
            continue
        w = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)[1]
        x = dy * step[2] - dz * step[1] - step[3]  # change of d with the pose step
        y = dz * step[0] - dx * step[2] - step[4]
        z = dx * step[1] - dy * step[0] - step[5]
        r0 += a0 * x + a1 * y + a2 * z
        r1 += b0 * x + b1 * y + b2 * z
        _add_normal(normal, pose, a0, a1, a2, b0, b1, b2, r0, r1, w)
    return times_symmetric(invert_symmetric(normal, 0.0), normal[6], normal[7], normal[8])


@_part
def _polish(
    j, obs, points, poses, old_poses, steps, substitute, num_steps, tolerance, point_costs,
    trial_points, scratch,
):  # fmt: skip
    """`polish_range` of landmark j; returns its cost."""
    normal, trial_normal, here, there = scratch
    here[0], here[1], here[2] = points[j, 0], points[j, 1], points[j, 2]
    if substitute:
        x, y, z = _substituted_step(obs, j, here, old_poses, steps, normal)
        here[0], here[1], here[2] = here[0] - x, here[1] - y, here[2] - z
    cost = _point_normal(obs, j, here, poses, normal)
    if substitute and not cost <= point_costs[j]:
        there[0], there[1], there[2] = points[j, 0], points[j, 1], points[j, 2]
        stay = _point_normal(obs, j, there, poses, trial_normal)
        if not cost <= stay:
            cost, here, there, normal, trial_normal = stay, there, here, trial_normal, normal
    damping = 0.0
    for _ in range(num_steps):
        inverse = invert_symmetric(normal, damping)
        x, y, z = times_symmetric(inverse, normal[6], normal[7], normal[8])
        gain = 0.5 * (x * normal[6] + y * normal[7] + z * normal[8])
        if not gain > tolerance * cost:
            break
        there[0], there[1], there[2] = here[0] - x, here[1] - y, here[2] - z
        trial = _point_normal(obs, j, there, poses, trial_normal)
        if trial < cost:
            cost, here, there, normal, trial_normal = trial, there, here, trial_normal, normal
            damping *= 0.1
        else:
            damping = max(1e-3, 10.0 * damping)
    trial_points[j, 0], trial_points[j, 1], trial_points[j, 2] = here[0], here[1], here[2]
    return cost


@_kernel
def polish_range(
    first, last, obs, points, poses, old_poses, steps, substitute, num_steps, tolerance,
    point_costs, trial_points, trial_costs,
):  # fmt: skip
    """Move landmarks first..last to (near) their optimum at `poses`.

    With `substitute`, they first take the linear step for pose `steps (F, 6)` from `old_poses`; if
    that raises a landmark's cost, it starts from its old position if that is better. Then up to
    `num_steps` damped Gauss-Newton steps that never raise the cost, ended when the next would gain
    less than `tolerance` of it. Writes `trial_points (J, 3)` and
    `trial_costs (J,)`.
    """
    scratch = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    for j in range(first, last):
        trial_costs[j] = _polish(
            j, obs, points, poses, old_poses, steps, substitute, num_steps, tolerance, point_costs,
            trial_points, scratch,
        )  # fmt: skip


@_part
def _write_residuals(j, obs, points, poses, residuals, valid):
    """`residuals_range` of landmark j."""
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        dx, dy, dz = rig_vector(poses[obs.frames[o]], points[j])
        valid[o], residuals[o, 0], residuals[o, 1] = _residual_from_rig(obs, o, dx, dy, dz)[:3]


@_kernel
def residuals_range(first, last, obs, points, poses, residuals, valid):
    """Write the whitened residuals (O, 2) and validity (O,) of landmarks first..last."""
    for j in range(first, last):
        _write_residuals(j, obs, points, poses, residuals, valid)


@_part
def _random_bits(seed):
    """64 random bits of a number: the finalizer of SplitMix64 (Steele, Lea, Flood, 2014)."""
    x = seed * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@_part
def _draw(j, obs, visits, points, poses, U, roots, seed, out, scratch):
    """`draw_run` of landmark j."""
    a, b, u, normal = scratch
    num = out.shape[2]
    point, row = points[j], j - visits.first
    u[:], normal[:] = 0.0, 0.0
    for o in range(obs.offsets[j], obs.offsets[j + 1]):
        f = obs.frames[o]
        dx, dy, dz = rig_vector(poses[f], point)
        valid, r0, r1, a0, a1, a2, b0, b1, b2 = _residual_from_rig(obs, o, dx, dy, dz)
        if not valid:
            continue
        weight = rho_and_weight(obs.loss, obs.loss_scale, r0 * r0 + r1 * r1)[1]
        w = np.sqrt(weight)
        _pose_row(a0, a1, a2, dx, dy, dz, a)
        _pose_row(b0, b1, b2, dx, dy, dz, b)
        rows = _add_normal(normal, poses[f], a0, a1, a2, b0, b1, b2, r0, r1, weight)
        bits = _random_bits(seed + np.uint64(o))
        for r in range(num):
            s0 = w if (bits >> np.uint64(r)) & np.uint64(1) else -w
            s1 = w if (bits >> np.uint64(32 + r)) & np.uint64(1) else -w
            for c in range(3):
                u[c, r] += s0 * rows[c] + s1 * rows[3 + c]
            for i in range(6):
                out[f, i, r] += s0 * a[i] + s1 * b[i]
    root = roots[row]
    least = np.sqrt(MIN_RELATIVE_DAMPING * (normal[0] + normal[3] + normal[5]))
    bits = _random_bits(~(seed + np.uint64(j)))
    for r in range(num):
        for c in range(3):
            u[c, r] += least if (bits >> np.uint64(3 * r + c)) & np.uint64(1) else -least
        x, y, z = u[0, r], u[1, r], u[2, r]
        u[0, r], u[1, r] = root[0] * x, root[1] * x + root[3] * y
        u[2, r] = root[2] * x + root[4] * y + root[5] * z
    for e in range(visits.offsets[row], visits.offsets[row + 1]):
        to, v = out[visits.frames[e]], U[e]
        for i in range(6):
            for r in range(num):
                to[i, r] -= v[0, i] * u[0, r] + v[1, i] * u[1, r] + v[2, i] * u[2, r]


@_kernel
def draw_run(obs, visits, points, poses, U, roots, seed, out):
    """Add to out (F, 6, R), R <= 21, vectors whose covariance is the Schur complement of a run.

    Vectors are J^T e of random signs e: as good as normal ones when many are added. The damping by
    `invert_symmetric` counts as an observation of the landmark.

    Args:
        U (V, 3, 6): see `factors.schur_complement.project_visits`.
        roots (L, 6): see `linearize_range`.
        seed: uint64.
    """
    scratch = np.empty(6), np.empty(6), np.empty((3, out.shape[2])), np.empty(9)
    for j in range(visits.first, visits.first + len(visits.offsets) - 1):
        _draw(j, obs, visits, points, poses, U, roots, seed, out, scratch)
