"""Compiled elimination of patches' planes from the models of their observations."""

import numpy as np

from factors.compiled import kernel_and_part
from factors.kernel_parts import invert_symmetric, rig_vector

_kernel, _part = kernel_and_part(fastmath={"contract"})
_, _allocating = kernel_and_part(allocating=True, fastmath={"contract"})


@_part
def _to_poses(host, target, by_host, by_target):
    """Rows (6, 6) that map right perturbations of both poses into the tangent (phi, tau).

    phi = A w_host - w_target and tau = A v_host - v_target + c x w_target.
    """
    by_host[:] = 0.0
    by_target[:] = 0.0
    cx, cy, cz = rig_vector(target, host[9:])
    for i in range(3):
        by_target[i, i] = -1.0
        by_target[3 + i, 3 + i] = -1.0
        for k in range(3):
            a = target[i] * host[k] + target[3 + i] * host[3 + k] + target[6 + i] * host[6 + k]
            by_host[i, k] = a
            by_host[3 + i, 3 + k] = a
    by_target[3, 1], by_target[3, 2] = -cz, cy
    by_target[4, 0], by_target[4, 2] = cz, -cx
    by_target[5, 0], by_target[5, 1] = -cy, cx


@_allocating
def _through(view, J):
    """Map rows J (6, 6) by right perturbations of a lens's pose to those of its rig.

    A step (w, v) of the rig is (R^T w, R^T (v + w x t)) of a lens at view = [R | t].
    """
    turned = np.empty(6)
    for r in range(6):
        for i in range(3):
            turned[i] = (
                J[r, 0] * view[3 * i] + J[r, 1] * view[3 * i + 1] + J[r, 2] * view[3 * i + 2]
            )
            turned[3 + i] = (
                J[r, 3] * view[3 * i] + J[r, 4] * view[3 * i + 1] + J[r, 5] * view[3 * i + 2]
            )
        x, y, z = turned[3], turned[4], turned[5]
        J[r, 0] = turned[0] + view[10] * z - view[11] * y
        J[r, 1] = turned[1] + view[11] * x - view[9] * z
        J[r, 2] = turned[2] + view[9] * y - view[10] * x
        J[r, 3], J[r, 4], J[r, 5] = x, y, z


@_allocating
def _add_product(P, G, Q, out):
    """out += P^T G Q for 6x6 P, Q and the pose part of a (9, 9) Hessian."""
    GQ = np.zeros((6, 6))
    for i in range(6):
        for k in range(6):
            factor = G[3 + i, 3 + k]
            for j in range(6):
                GQ[i, j] += factor * Q[k, j]
    for k in range(6):
        for i in range(6):
            factor = P[k, i]
            for j in range(6):
                out[i, j] += factor * GQ[k, j]


@_part
def _add_coupling(P, G, g, W, gradient):
    """W (3, 6) += plane-by-pose part of G through P; the pose's gradient (6) likewise."""
    for k in range(6):
        for j in range(6):
            gradient[j] += P[k, j] * g[3 + k]
            for i in range(3):
                W[i, j] += G[i, 3 + k] * P[k, j]


@_part
def _add_pair(f, g, block, row_starts, columns, off_diagonal):
    """Add H[f, g] to the pairs, which hold the upper half."""
    low, high = min(f, g), max(f, g)
    first, last = row_starts[low], row_starts[low + 1]
    while last - first > 1:  # columns of a row ascend
        middle = (first + last) // 2
        if columns[middle] <= high:
            first = middle
        else:
            last = middle
    out = off_diagonal[first]
    for i in range(6):
        for j in range(6):
            out[i, j] += block[i, j] if f < g else block[j, i]


@_allocating
def _reduce(
    host, targets, W, inverse, down, row_starts, columns, diagonal, off_diagonal, gradient
):  # fmt: skip
    """Subtract a patch's Schur complement from its host and targets."""
    block, Y = np.empty((6, 6)), np.empty((6, 3))
    for i in range(len(targets) + 1):
        f = host if i == 0 else targets[i - 1]
        for r in range(6):
            for k in range(3):
                Y[r, k] = (
                    W[i, 0, r] * inverse[0, k]
                    + W[i, 1, r] * inverse[1, k]
                    + W[i, 2, r] * inverse[2, k]
                )
            gradient[f, r] -= Y[r, 0] * down[0] + Y[r, 1] * down[1] + Y[r, 2] * down[2]
        for k in range(i, len(targets) + 1):
            for r in range(6):
                for c in range(6):
                    block[r, c] = -(
                        Y[r, 0] * W[k, 0, c] + Y[r, 1] * W[k, 1, c] + Y[r, 2] * W[k, 2, c]
                    )
            if k == i:
                diagonal[f] += block
            else:
                _add_pair(f, targets[k - 1], block, row_starts, columns, off_diagonal)


@_kernel
def eliminate_range(
    first, last, hosts, offsets, targets, host_poses, target_poses, host_views, target_views,
    hessians, gradients, priors, row_starts, columns, diagonal, off_diagonal, gradient, couplings,
    inverses, plane_gradients,
):  # fmt: skip
    """Add patches first..last, their planes eliminated, to a reduced pose system.

    Args: host_poses (P, 12), target_poses (O, 12): lens poses that host and observe patches, as
        pose rows. host_views (P, 12), target_views (O, 12): those lenses in their rigs. hessians
        (O, 9, 9), gradients (O, 9): models of the observations in their own tangents. priors (P,
        6): weights (3) on the plane, then its gradient (3). row_starts (F + 1,), columns (Q,):
        frame pairs i < k as sorted CSR rows. diagonal (F, 6, 6), off_diagonal (Q, 6, 6), gradient
        (F, 6): accumulated. couplings (P + O, 3, 6): written, rows offsets[p] + p of the host, then
        of the targets. inverses (P, 3, 3), plane_gradients (P, 3): written; with the couplings they
        give the step of a plane, -inverse (gradient + sum of coupling @ pose step).
    """
    by_host, by_target = np.empty((6, 6)), np.empty((6, 6))
    V, block = np.empty((3, 3)), np.empty((6, 6))
    for p in range(first, last):
        host, row = hosts[p], offsets[p] + p
        num = offsets[p + 1] - offsets[p]
        W = couplings[row : row + num + 1]
        W[:] = 0.0
        V[:] = 0.0
        down = plane_gradients[p]
        for k in range(3):
            V[k, k] = priors[p, k]
            down[k] = priors[p, 3 + k]
        for i in range(num):
            o = offsets[p] + i
            target, G, g = targets[o], hessians[o], gradients[o]
            _to_poses(host_poses[p], target_poses[o], by_host, by_target)
            _through(host_views[p], by_host)
            _through(target_views[o], by_target)
            _add_product(by_host, G, by_host, diagonal[host])
            _add_product(by_target, G, by_target, diagonal[target])
            block[:] = 0.0
            _add_product(by_host, G, by_target, block)
            _add_pair(host, target, block, row_starts, columns, off_diagonal)
            _add_coupling(by_host, G, g, W[0], gradient[host])
            _add_coupling(by_target, G, g, W[i + 1], gradient[target])
            for k in range(3):
                down[k] += g[k]
                for j in range(3):
                    V[k, j] += G[k, j]
        inverse = inverses[p]
        upper = V[0, 0], V[0, 1], V[0, 2], V[1, 1], V[1, 2], V[2, 2]
        a, b, c, d, e, f = invert_symmetric(upper, 0.0)
        inverse[0, 0], inverse[0, 1], inverse[0, 2] = a, b, c
        inverse[1, 0], inverse[1, 1], inverse[1, 2] = b, d, e
        inverse[2, 0], inverse[2, 1], inverse[2, 2] = c, e, f
        _reduce(
            host, targets[offsets[p] : offsets[p + 1]], W, inverse, down, row_starts, columns,
            diagonal, off_diagonal, gradient,
        )  # fmt: skip
