"""Compiled pass over observations by a camera with two lenses or more: residuals and all Jacobians.

A point X is at d = world_R_rig^T (X - t) in the rig in the middle of the readout. The row that sees
it is read a fraction s of the readout away from the middle, when the rig has turned by Q = exp(s w)
and moved by s m: the point is then at e = Q^T (d - s m). Its lens is at o = A c_l, A the axes of
the frame's lenses: the point is along l = e - o from there. A panorama stitched for a radius 1 / k
shows it in the direction p of unit length where the ray from the lens, towards l / |l|, meets the
sphere of radius one around the rig, the lens being at n = k o:

    p = n + h u,    u = l / |l|,    h = sqrt(1 + (n u)^2 - n^2) - n u.

The residual is the log map of p at the measured direction, whitened. Of raw pairs it is the pixel
of l by the lens, r = f (theta + k1 theta^3 + ... + k4 theta^9) from the principal point, less the
measured one, whitened.
"""

import numpy as np

from factors.compiled import kernel_and_part
from factors.kernel_parts import invert_symmetric, rig_vector, tangent_axes, times_symmetric
from factors.robust import rho_and_weight

_EPS = 1e-300  # guards divisions by a squared norm
_BEHIND = 1e-12  # sine of the angle below which no direction leads back to the measured one

_kernel, _part = kernel_and_part(fastmath={"contract"})
_, _allocating = kernel_and_part(allocating=True, fastmath={"contract"})


@_part
def _set_rotation(x, y, z, out):
    """Write the rotation matrix (3, 3) of a rotation vector, by Rodrigues' formula."""
    t2 = x * x + y * y + z * z
    a = 1.0 - t2 * (1 / 6 - t2 * (1 / 120 - t2 / 5040))  # a readout turns by a degree or so
    b = 0.5 - t2 * (1 / 24 - t2 * (1 / 720 - t2 / 40320))
    if t2 > 0.01:
        t = np.sqrt(t2)
        a, b = np.sin(t) / t, (1.0 - np.cos(t)) / t2
    out[0, 0], out[0, 1], out[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    out[1, 0], out[1, 1], out[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    out[2, 0], out[2, 1], out[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@_part
def _cross(a, b):
    """Components of a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_part
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_part
def _times(matrix, v, out):
    """out = matrix v."""
    for i in range(3):
        out[i] = matrix[i, 0] * v[0] + matrix[i, 1] * v[1] + matrix[i, 2] * v[2]


@_part
def _times_transposed(matrix, v, out):
    """out = matrix^T v."""
    for i in range(3):
        out[i] = matrix[0, i] * v[0] + matrix[1, i] * v[1] + matrix[2, i] * v[2]


@_part
def _direction_residual(measured, whitener, p, r, by_p):
    """Whitened log map r (2,) of a unit direction p at a measured one, and its Jacobian by p."""
    mx, my, mz = measured
    ax, ay, az, bx, by, bz = tangent_axes(mx, my, mz)
    x = ax * p[0] + ay * p[1] + az * p[2]
    y = bx * p[0] + by * p[1] + bz * p[2]
    z = mx * p[0] + my * p[1] + mz * p[2]
    s2 = x * x + y * y
    if z > 0 and s2 < 0.01:
        f = 1.0 + s2 * (1 / 6 + s2 * (3 / 40 + s2 * (15 / 336 + s2 * 105 / 3456)))
        k = -2 / 3 - s2 * (1 / 5 + s2 * (3 / 28 + s2 * 5 / 72))
    else:
        s = np.sqrt(s2)
        if s < _BEHIND:
            r[0], r[1] = whitener[0, 0] * np.pi, 0.0
            by_p[:] = 0.0
            return
        f = np.arctan2(s, z) / s
        k = (z - f) / s2
    for i in range(2):  # d r = (f I + k (x, y) (x, y)^T) d (x, y) - (x, y) d z
        s0, s1 = whitener[i, 0], whitener[i, 1]
        r[i] = f * (s0 * x + s1 * y)
        along = k * (s0 * x + s1 * y)
        u, v, w = s0 * f + along * x, s1 * f + along * y, -(s0 * x + s1 * y)
        by_p[i, 0] = u * ax + v * bx + w * mx
        by_p[i, 1] = u * ay + v * by + w * my
        by_p[i, 2] = u * az + v * bz + w * mz


@_part
def _stitched_residual(measured, whitener, n, away, r, by_away, by_n, by_p):
    """Residual of a point along `away` from its lens, in a panorama with that lens at n.

    Writes r (2,) and its Jacobians (2, 3) by `away` and by n: zeros where the point is at its lens.
    """
    length = np.sqrt(_dot(away, away))
    if length * length < _EPS:
        r[0], r[1] = whitener[0, 0] * np.pi, 0.0
        by_away[:], by_n[:] = 0.0, 0.0
        return
    ux, uy, uz = away[0] / length, away[1] / length, away[2] / length
    along = n[0] * ux + n[1] * uy + n[2] * uz
    root = np.sqrt(max(1.0 + along * along - _dot(n, n), 1e-12))
    h = root - along
    p = n[0] + h * ux, n[1] + h * uy, n[2] + h * uz
    _direction_residual(measured, whitener, p, r, by_p)
    for i in range(2):
        v0, v1, v2 = by_p[i, 0], by_p[i, 1], by_p[i, 2]
        vu = v0 * ux + v1 * uy + v2 * uz
        a = h / root * vu
        x, y, z = h * v0 - a * n[0], h * v1 - a * n[1], h * v2 - a * n[2]
        b = x * ux + y * uy + z * uz
        by_away[i, 0] = (x - b * ux) / length
        by_away[i, 1] = (y - b * uy) / length
        by_away[i, 2] = (z - b * uz) / length
        by_n[i, 0] = v0 - a * ux - vu * n[0] / root
        by_n[i, 1] = v1 - a * uy - vu * n[1] / root
        by_n[i, 2] = v2 - a * uz - vu * n[2] / root


@_part
def _pixel_residual(measured, whitener, lens, away, r, by_away, by_lens):
    """Residual (2,) of a point along `away` in the pixels of a raw lens, and its Jacobians.

    Args:
        lens: (16,) focal length, principal point (2), k1 to k4, rig_R_lens row-major (9).
        by_away, by_lens: (2, 3) and (2, 7) written, the latter by log focal length, principal
            point, k1 to k4.
    """
    x = lens[7] * away[0] + lens[10] * away[1] + lens[13] * away[2]
    y = lens[8] * away[0] + lens[11] * away[1] + lens[14] * away[2]
    z = lens[9] * away[0] + lens[12] * away[1] + lens[15] * away[2]
    across, squared = np.sqrt(x * x + y * y), x * x + y * y + z * z
    if squared < _EPS:
        r[0], r[1] = whitener[0, 0] * lens[0] * np.pi, 0.0
        by_away[:], by_lens[:] = 0.0, 0.0
        return
    theta, f = np.arctan2(across, z), lens[0]
    t2 = theta * theta
    shape = 1.0 + t2 * (lens[3] + t2 * (lens[4] + t2 * (lens[5] + t2 * lens[6])))
    slope = 1.0 + t2 * (3 * lens[3] + t2 * (5 * lens[4] + t2 * (7 * lens[5] + 9 * t2 * lens[6])))
    cx, cy, stretch = 1.0, 0.0, f / max(z, _EPS)  # in the middle
    if across > 1e-9 * np.sqrt(squared):
        cx, cy, stretch = x / across, y / across, f * theta * shape / across
    radius = f * theta * shape
    out, in_ = f * slope * z / squared, -f * slope * across / squared
    rx, ry = radius * cx + lens[1] - measured[0], radius * cy + lens[2] - measured[1]
    for i in range(2):
        s0, s1 = whitener[i, 0], whitener[i, 1]
        r[i] = s0 * rx + s1 * ry
        radial = s0 * cx + s1 * cy
        a = radial * (out - stretch)  # pixels by the vector in the lens's frame
        jx, jy, jz = a * cx + stretch * s0, a * cy + stretch * s1, radial * in_
        by_away[i, 0] = lens[7] * jx + lens[8] * jy + lens[9] * jz
        by_away[i, 1] = lens[10] * jx + lens[11] * jy + lens[12] * jz
        by_away[i, 2] = lens[13] * jx + lens[14] * jy + lens[15] * jz
        by_lens[i, 0] = radial * radius
        by_lens[i, 1], by_lens[i, 2] = s0, s1
        power = f * theta * radial
        for k in range(4):
            power *= t2
            by_lens[i, 3 + k] = power


@_part
def _by_motion(tau, e, moved, by_e, by_d, out):
    """Row (6,) by the motion during the readout from rows by e and by d - s m.

    Args:
        moved: (3,) tau times the rotation vector.
    """
    a = _cross(by_e, e)
    b = _cross(a, moved)
    c = _cross(b, moved)
    for i in range(3):
        out[i] = tau * (a[i] - b[i] / 2 + c[i] / 6)  # the right Jacobian of rotations
        out[3 + i] = -tau * by_d[i]


@_allocating
def _scratch():
    """Arrays that `_see` writes to."""
    return (
        np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3),
        np.empty(3), np.empty((2, 3)), np.zeros((2, 3)), np.empty((2, 3)), np.empty((2, 7)),
        np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(6),
    )  # fmt: skip


@_part
def _look(
    tau, centre, motion, axes, inverse_radius, X, pose, turn, d, q, e, origin, away, n, moved
):  # fmt: skip
    """Write where a point is: d, e, the lens's o and n, l = e - o, and Q and s w."""
    d[0], d[1], d[2] = rig_vector(pose, X)
    for i in range(3):
        moved[i], q[i] = tau * motion[i], d[i] - tau * motion[3 + i]
    _set_rotation(moved[0], moved[1], moved[2], turn)
    _times_transposed(turn, q, e)
    _times(axes, centre, origin)
    for i in range(3):
        away[i] = e[i] - origin[i]
        n[i] = inverse_radius * origin[i]


@_part
def _set_by_lenses(columns, camera, lens, by_lens, turning, own, shared):
    """Write a row's columns by what raw lenses are, from those by the one that sees the point.

    Args:
        by_lens: (7,) row of `_pixel_residual`.
        turning: (3,) row by a left turn of the lens.
    """
    start = columns.lenses[lens]
    for i in range(7):
        shared[start + i] = by_lens[i] * camera.steps[lens, i]
    if lens > columns.first[lens]:  # the front lens's axes are the rig's
        _times_transposed(camera.by_lens_turn[lens], turning, own)
        for i in range(3):
            shared[start + 7 + i] = own[i]


@_part
def _clear(row, shared):
    """Set columns to zero: variables of other cameras do not act on what this one sees."""
    for i in range(len(row)):
        row[i] = 0.0
    for i in range(len(shared)):
        shared[i] = 0.0


@_part
def _see(
    o, sightings, camera, columns, X, pose, scratch, residual, by_point, by_frame, by_shared, asked
):  # fmt: skip
    """Residual (2,) of observation o of a point X, and its Jacobian (2, 3) by that.

    Where `asked`, also those by coordinates of the frame (2, K) and of all frames (2, S).
    """
    (
        turn, d, q, e, own, origin, away, by_away, by_n, by_p, by_lens, by_d, by_origin, n, moved,
        motion_row,
    ) = scratch  # fmt: skip
    f, lens, tau = sightings.frames[o], sightings.lenses[o], sightings.fractions[o]
    _look(
        tau, camera.centres[lens], camera.motions[f], camera.axes[f], camera.inverse_radii[lens], X,
        pose, turn, d, q, e, origin, away, n, moved,
    )  # fmt: skip
    measured, whitener = sightings.measured[o], sightings.whiteners[o]
    first, last, inverse = columns.first[lens], columns.last[lens], camera.inverse_radii[lens]
    if columns.lenses[lens] >= 0:
        _pixel_residual(measured, whitener, camera.lenses[lens], away, residual, by_away, by_lens)
    else:
        _stitched_residual(measured, whitener, n, away, residual, by_away, by_n, by_p)
    for r in range(2):
        by_e = by_away[r]
        _times(turn, by_e, by_d)
        for i in range(3):
            by_point[r, i] = (
                pose[3 * i] * by_d[0] + pose[3 * i + 1] * by_d[1] + pose[3 * i + 2] * by_d[2]
            )
        if not asked:
            continue
        row, shared = by_frame[r], by_shared[r]
        _clear(row, shared)
        row[0], row[1], row[2] = _cross(by_d, d)
        row[3], row[4], row[5] = -by_d[0], -by_d[1], -by_d[2]
        by_radius = 0.0
        for i in range(3):
            by_origin[i] = inverse * by_n[r, i] - by_e[i]
            by_radius += by_n[r, i] * origin[i]
        _times_transposed(camera.axes[f], by_origin, own)
        for k in range(first, last):  # the last lens's centre is minus the sum of the others
            share = 1.0 if lens == k else (-1.0 if lens == last else 0.0)
            for i in range(3):
                at = columns.centres[lens] + 3 * (k - first) + i
                shared[at] = share * own[i] + by_radius * camera.radius_by_centre[at]
        if columns.radius[lens] >= 0:
            shared[columns.radius[lens]] = by_radius
        if columns.readout[lens] >= 0:
            _by_motion(tau, e, moved, by_e, by_d, motion_row)
            slope = 0.0
            for i in range(6):
                row[columns.motion[lens] + i] = motion_row[i]
                slope += motion_row[i] * camera.velocities[f, i]
            shared[columns.readout[lens]] = slope
        if columns.turns[lens] >= 0:
            _times_transposed(camera.by_turn[lens, f], by_origin, own)
            row[columns.turns[lens]], row[columns.turns[lens] + 1] = own[0], own[1]
        if columns.lenses[lens] >= 0:
            q[0], q[1], q[2] = _cross(by_e, away)  # by a left turn of the lens
            _set_by_lenses(columns, camera, lens, by_lens[r], q, own, shared)


@_kernel
def see_range(
    first, last, sightings, camera, columns, points, poses, residuals, by_point, by_frame, by_shared
):  # fmt: skip
    """Write residuals and Jacobians, whitened, of observations first..last, from row 0 on.

    Args:
        sightings, camera, columns: see `factors.camera_rows`.
        points (J, 3), poses (F, 12): as in `factors._kernels`.
        residuals (O, 2), by_point (O, 2, 3), by_frame (O, 2, K), by_shared (O, 2, S).
    """
    scratch = _scratch()
    for o in range(first, last):
        at = o - first
        _see(
            o, sightings, camera, columns, points[sightings.points[o]], poses[sightings.frames[o]],
            scratch, residuals[at], by_point[at], by_frame[at], by_shared[at], True,
        )  # fmt: skip


@_part
def _add_normal(normal, residual, by_point, weight):
    """Add to a landmark's Hessian (00 01 02 11 12 22) and gradient (3) in `normal (9,)`."""
    for r in range(2):
        a, b, c = by_point[r, 0], by_point[r, 1], by_point[r, 2]
        wa, wb, wc, w = weight * a, weight * b, weight * c, weight * residual[r]
        normal[0] += wa * a
        normal[1] += wa * b
        normal[2] += wa * c
        normal[3] += wb * b
        normal[4] += wb * c
        normal[5] += wc * c
        normal[6] += w * a
        normal[7] += w * b
        normal[8] += w * c


@_part
def _substitute(
    j, sightings, camera, columns, X, poses, own_steps, shared_steps, loss, scale, scratch, rows,
    normal, out,
):  # fmt: skip
    """Write where landmark j goes with steps of frames (F, K) and of what they share (S,)."""
    residual, by_point, by_frame, by_shared = rows
    normal[:] = 0.0
    for o in range(sightings.offsets[j], sightings.offsets[j + 1]):
        f = sightings.frames[o]
        _see(
            o, sightings, camera, columns, X, poses[f], scratch, residual, by_point, by_frame,
            by_shared, True,
        )  # fmt: skip
        squared = residual[0] * residual[0] + residual[1] * residual[1]
        weight = rho_and_weight(loss, scale, squared)[1]
        for r in range(2):
            for k in range(own_steps.shape[1]):
                residual[r] += by_frame[r, k] * own_steps[f, k]
            for k in range(len(shared_steps)):
                residual[r] += by_shared[r, k] * shared_steps[k]
        _add_normal(normal, residual, by_point, weight)
    x, y, z = times_symmetric(invert_symmetric(normal, 0.0), normal[6], normal[7], normal[8])
    out[0], out[1], out[2] = X[0] - x, X[1] - y, X[2] - z


@_kernel
def polish_range(
    first, last, sightings, camera, columns, points, poses, old_camera, old_poses, own_steps,
    shared_steps, substitute, loss, scale, num_steps, tolerance, point_costs, trial_points,
    trial_costs,
):  # fmt: skip
    """Move landmarks first..last to (near) their optimum with a camera and poses.

    With `substitute`, they first take the linear step that goes with steps of what frames have
    (F, K) and share (S,) from the old camera and poses; where that makes a landmark worse than its
    old cost, it starts from its old place if that is better. Then up to `num_steps` damped
    Gauss-Newton steps that never raise the cost, ended where the next would gain less than
    `tolerance` of it. Writes `trial_points (J, 3)` and `trial_costs (J,)`.
    """
    scratch = _scratch()
    rows = (
        np.empty(2), np.empty((2, 3)), np.zeros((2, own_steps.shape[1])),
        np.zeros((2, len(shared_steps))),
    )  # fmt: skip
    residual, by_point, by_frame, by_shared = rows
    normal, trial_normal, here, there = np.empty(9), np.empty(9), np.empty(3), np.empty(3)
    for j in range(first, last):
        there[:] = points[j]
        if substitute:
            _substitute(
                j, sightings, old_camera, columns, points[j], old_poses, own_steps, shared_steps,
                loss, scale, scratch, rows, normal, there,
            )  # fmt: skip
        cost, damping, steps, stayed = np.inf, 0.0, 0, not substitute
        while True:
            trial = 0.0
            trial_normal[:] = 0.0
            for o in range(sightings.offsets[j], sightings.offsets[j + 1]):
                _see(
                    o, sightings, camera, columns, there, poses[sightings.frames[o]], scratch,
                    residual, by_point, by_frame, by_shared, False,
                )  # fmt: skip
                squared = residual[0] * residual[0] + residual[1] * residual[1]
                rho, weight = rho_and_weight(loss, scale, squared)
                trial += rho
                _add_normal(trial_normal, residual, by_point, weight)
            if trial < cost or cost == np.inf:
                cost, here, there, normal, trial_normal = trial, there, here, trial_normal, normal
                damping *= 0.1
            else:
                damping = max(1e-3, 10.0 * damping)
            if not stayed:
                stayed, damping = True, 0.0
                if not cost <= point_costs[j]:
                    there[:] = points[j]
                    continue
            inverse = invert_symmetric(normal, damping)
            x, y, z = times_symmetric(inverse, normal[6], normal[7], normal[8])
            gain = 0.5 * (x * normal[6] + y * normal[7] + z * normal[8])
            if steps == num_steps or not gain > tolerance * cost:
                break
            steps += 1
            there[0], there[1], there[2] = here[0] - x, here[1] - y, here[2] - z
        trial_points[j, 0], trial_points[j, 1], trial_points[j, 2] = here[0], here[1], here[2]
        trial_costs[j] = cost
