"""The compiled search of guided matching: selects and compares descriptors, and keeps the best."""

from typing import NamedTuple

import numpy as np

from factors.compiled import kernel_and_part

HEAD = 24  # axes of a descriptor compared before the rest
_ZERO = np.float32(0)
_MIN_SINE = np.float32(0.05)  # least sine of the angle to the motion; nearer to it, epipolar
# planes are undetermined
_FAST = {"contract", "reassoc", "nsz", "arcp"}
_kernel, _part = kernel_and_part(fastmath=_FAST)
_, _allocating = kernel_and_part(allocating=True, fastmath=_FAST)


class Limits(NamedTuple):
    """A gate and the thresholds on descriptors, as the compiled search takes them."""

    rotation: np.float32  # radians, uncertainty of the relative rotation
    direction: np.float32  # tangent of the uncertainty of the motion's direction
    chord: np.float32  # largest distance of both bearings on the unit sphere
    point: np.float32  # radians, uncertainty of a known point's bearing
    similarity: np.float32  # least cosine similarity of descriptors
    ratio: np.float32  # largest ratio of descriptor distances


class Rows(NamedTuple):
    """A frame's features in the form the search compares, all float32."""

    bearings: np.ndarray  # (n, 3), frame 0's axes
    descriptors: np.ndarray  # (n, D) of length one
    tails: np.ndarray  # (n) norm of a descriptor beyond its first HEAD axes


class Cells(NamedTuple):
    """Cells of neighbouring rows: balls around their bearings, frame 0's axes."""

    starts: np.ndarray  # (C + 1) first row of each cell
    centres: np.ndarray  # (C, 3) float32
    radii: np.ndarray  # (C) float32, chords


@_kernel
def search(first, second, cells, targets, only_targets, direction, limits):
    """Best row of the second frame for every row of the first, or -1, and its similarity.

    Args:
        first, second: Rows of both frames.
        cells: Cells of the second.
        targets: (n0, 3) float32 predicted bearings of the first frame's rows, NaN where unknown.
        only_targets: search around the targets, not along epipolar lines.
        direction, limits: unit vector of the motion, and Limits.
    """
    descriptors0, descriptors1 = first.descriptors, second.descriptors
    n0, n1, dim = len(descriptors0), len(descriptors1), descriptors0.shape[1]
    head = min(HEAD, dim)
    # Contiguous, so that they stay in the cache.
    head0 = _first_axes(descriptors0, head, np.empty((n0, head), np.float32))
    head1 = _first_axes(descriptors1, head, np.empty((n1, head), np.float32))
    columns, balls = _columns(second.bearings), _columns(cells.centres)
    no_radii = _filled(n1, 0.0)
    marks, worth = np.empty(n1, np.bool_), np.empty(len(cells.radii), np.bool_)
    found0, found1 = _no_candidates(n0), _no_candidates(n1)
    for i in range(n0):
        if not (only_targets and np.isnan(targets[i, 0])):
            _search_row(
                i, first, second, (head0, head1), cells, columns, balls, no_radii, targets,
                only_targets, direction, limits, marks, worth, found0, found1,
            )  # fmt: skip
    best0, top0, next0 = found0
    best1, _, next1 = found1
    _keep_mutual(best0, top0, next0, best1, next1, limits)
    return best0, top0


@_part
def _search_row(
    i, first, second, heads, cells, columns, balls, no_radii, targets, only_targets, direction,
    limits, marks, worth, found0, found1,
):  # fmt: skip
    """Compare row i of the first frame with the rows of the second that it may match.

    Args:
        heads: the first axes of both frames' descriptors.
        columns, balls: coordinates of the second's bearings, and of its cells' centres.
        no_radii: zero for each row of the second.
        marks, worth: scratch, flags of rows and of cells.
        found0, found1: candidates so far of both frames' rows.
    """
    bearings0, descriptors0, tails0 = first
    bearings1, descriptors1, tails1 = second
    starts, _, radii = cells
    heads0, heads1 = heads
    x, y, z = columns
    best0, top0, next0 = found0
    best1, top1, next1 = found1
    head, dim = heads0.shape[1], descriptors0.shape[1]
    # A candidate with a lower similarity neither wins nor rivals the weakest winner.
    floor = 1 - (1 - limits.similarity) / (limits.ratio * limits.ratio)
    bearing = bearings0[i, 0], bearings0[i, 1], bearings0[i, 2]
    target = targets[i, 0], targets[i, 1], targets[i, 2]
    circle = _great_circle(bearing, direction, limits)
    rest0 = descriptors0[i, head:]
    about = target, bearing, direction, circle, limits
    _mark_balls(balls, radii, only_targets, about, worth)
    for cell in range(len(radii)):
        if not worth[cell] or starts[cell] == starts[cell + 1]:
            continue
        begin, end = starts[cell], starts[cell + 1]
        members = x[begin:end], y[begin:end], z[begin:end]
        _mark_balls(members, no_radii[begin:end], only_targets, about, marks)
        for j in range(begin, end):
            if not marks[j - begin]:
                continue
            dot = _ZERO
            for d in range(head):
                dot += heads0[i, d] * heads1[j, d]
            if dot + tails0[i] * tails1[j] < floor:  # Cauchy-Schwarz on the other axes
                continue
            rest1 = descriptors1[j, head:]
            for d in range(dim - head):  # a possibly negative index would compile to gathers
                dot += rest0[d] * rest1[d]
            if dot > next0[i]:
                _update_best(best0, top0, next0, i, j, dot, bearings1)
            if dot > next1[j]:
                _update_best(best1, top1, next1, j, i, dot, bearings0)


@_kernel
def passes(bearings0, bearings1, targets, only_targets, direction, limits):
    """True (n,) for the rows of two frames, paired one to one, that `search` would compare.

    Args:
        bearings0, bearings1: (n, 3) float32, frame 0's axes.
        targets, only_targets, direction, limits: as for `search`.
    """
    n = len(bearings0)
    passed = np.zeros(n, np.bool_)
    for i in range(n):
        other = bearings1[i, 0], bearings1[i, 1], bearings1[i, 2]
        if only_targets:
            target = targets[i, 0], targets[i, 1], targets[i, 2]
            passed[i] = _distance(target, other) <= limits.point  # not so where NaN
        else:
            bearing = bearings0[i, 0], bearings0[i, 1], bearings0[i, 2]
            circle = _great_circle(bearing, direction, limits)
            passed[i] = _in_band(other, _ZERO, bearing, direction, circle, limits)
    return passed


@_allocating
def _columns(rows):
    """The coordinates of points (n, 3), each in a row of its own."""
    n = len(rows)
    x, y, z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(n):
        x[i], y[i], z[i] = rows[i, 0], rows[i, 1], rows[i, 2]
    return x, y, z


@_allocating
def _first_axes(rows, head, out):
    """Copy the first axes of descriptors (n, D) to `out` (n, head)."""
    for i in range(len(rows)):
        for d in range(head):
            out[i, d] = rows[i, d]
    return out


@_allocating
def _filled(n, value):
    """Array (n,) of one value."""
    out = np.empty(n, np.float32)
    for i in range(n):
        out[i] = value
    return out


@_allocating
def _no_candidates(n):
    """Initial best candidate of n rows, its similarity, and that of the best at another place."""
    best = np.empty(n, np.int32)
    for i in range(n):
        best[i] = -1
    return best, _filled(n, -1.0), _filled(n, -1.0)


@_part
def _keep_mutual(best0, top0, next0, best1, next1, limits):
    """Reset, in place, candidates that are not the best both ways by a margin."""
    for i in range(len(best0)):
        j = best0[i]
        if j >= 0 and not (
            best1[j] == i and _passes_ratio_test(top0[i], max(next0[i], next1[j]), limits)
        ):
            best0[i] = -1


@_part
def _great_circle(bearing, direction, limits):
    """Normal of the epipolar plane of a bearing; largest cosine to the motion of a bearing that is
    not displaced towards it; distance off the plane, per unit of parallax, that an error of the
    motion's direction causes."""
    (ax, ay, az), (tx, ty, tz) = bearing, direction
    nx, ny, nz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
    sine = np.sqrt(nx * nx + ny * ny + nz * nz)
    if sine > 1e-6:
        nx, ny, nz = nx / sine, ny / sine, nz / sine
    slack = limits.rotation * (sine + limits.rotation)
    spread = limits.direction / max(sine, _MIN_SINE)
    return (nx, ny, nz), tx * ax + ty * ay + tz * az + slack, spread


@_part
def _in_band(ball, radius, bearing, direction, circle, limits):
    """True if a bearing within `radius` of the centre of a ball can show the same point.

    It lies on the great circle, no further than parallax goes, and is not displaced towards the
    direction of motion, as points behind both frames would be.
    """
    normal, max_cosine, spread = circle
    chord = _distance(bearing, ball)
    band = spread * (chord + radius)
    return (
        (chord - radius <= limits.chord + limits.rotation)
        & (abs(_dot(normal, ball)) - radius <= limits.rotation + band)
        & (_dot(direction, ball) - radius <= max_cosine + band)
    )


@_part
def _mark_balls(centres, radii, only_targets, about, marks):
    """Flags of the balls around (3, m) that pass; free of branches, so that it is vectorised."""
    target, bearing, direction, circle, limits = about
    x, y, z = centres
    if only_targets:
        for m in range(len(radii)):
            marks[m] = _distance(target, (x[m], y[m], z[m])) <= limits.point + radii[m]
    else:
        for m in range(len(radii)):
            ball = x[m], y[m], z[m]
            marks[m] = _in_band(ball, radii[m], bearing, direction, circle, limits)


@_part
def _update_best(best, top, second, row, candidate, similarity, bearings):
    """Update a row's best and second best candidate; the second must lie elsewhere than the
    best."""
    elsewhere = best[row] < 0 or not _at_one_place(bearings, best[row], candidate)
    if similarity > top[row]:
        if elsewhere:
            second[row] = top[row]
        best[row], top[row] = candidate, similarity
    elif elsewhere:
        second[row] = similarity


@_part
def _passes_ratio_test(similarity, second, limits):
    """Ratio test on descriptor distances: half their squares are 1 - similarity."""
    ratio = limits.ratio * limits.ratio
    return similarity >= limits.similarity and 1 - similarity <= ratio * (1 - second)


@_part
def _at_one_place(bearings, a, b):
    """True if two rows are one feature found twice: closer than 0.18 degrees."""
    x = bearings[a, 0] - bearings[b, 0]
    y = bearings[a, 1] - bearings[b, 1]
    z = bearings[a, 2] - bearings[b, 2]
    return x * x + y * y + z * z <= 1e-5


@_part
def _distance(a, b):
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@_part
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
