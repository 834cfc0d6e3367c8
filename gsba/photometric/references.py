"""Selection of frames for a point: its reference frame, and the frames it is searched in."""

import numpy as np

from factors.compiled import kernel_and_part
from gsba.types import Landmarks

_MAX_VIEWS = 16  # most places that a point is aligned at
_NEAR_FRAMES = 40  # nearest frames in space that may show a point
MAX_ANGLE_DEG = 45.0  # between two rays of a point
MAX_RATIO = 1.8  # of a point's distances from two frames

_kernel, _part = kernel_and_part()


def references(landmarks: Landmarks, world_T_rigs: np.ndarray) -> np.ndarray:
    """Row (J,) of each point's most central observation.

    It minimises the sum of squared angles between views, and of squared log ratios of distances, to
    the point's other observations.
    """
    centres = np.ascontiguousarray(world_T_rigs[:, :3, 3])
    out = np.zeros(len(landmarks.points_world), np.int64)
    _references(_starts(landmarks), landmarks.tracks.frames, centres, landmarks.points_world, out)
    return out


def visible_frames(
    landmarks: Landmarks,
    world_T_rigs: np.ndarray,
    rows: np.ndarray,
    extended: np.ndarray,
    places: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Frames (O,) int64 in which points (O,) int64, by point, are searched, without their
    references.

    They are the frames of a point's observations, and for points of `extended (J,)` those near its
    reference, observation rows (J,), in space, at any time, that see it from a similar direction
    and distance: the most similar first, and one of each place (F,), see `standing_places`.
    """
    centres = np.ascontiguousarray(world_T_rigs[:, :3, 3])
    frames, points = landmarks.tracks.frames, landmarks.points_world
    num_near = min(_NEAR_FRAMES, places[-1])
    near = np.empty((len(centres), num_near), np.int64)
    for f in np.unique(frames[rows]):
        distances = np.linalg.norm(centres - centres[f], axis=1)
        order = np.argsort(distances, kind="stable")
        order = order[np.sort(np.unique(places[order], return_index=True)[1])]  # one of each place
        near[f] = order[places[order] != places[f]][:num_near]
    room = len(frames) + _MAX_VIEWS * len(points)
    out = np.empty((2, room), np.int64)
    limits = np.cos(np.deg2rad(MAX_ANGLE_DEG)), MAX_RATIO
    num = _views(
        _starts(landmarks), frames, places, centres, points, rows, near, *limits, _MAX_VIEWS,
        extended, out,
    )  # fmt: skip
    return out[0, :num].copy(), out[1, :num].copy()


def view_differences(
    one: np.ndarray, other: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cosines (N,) of the angles between two views of points, ratios (N,) of their distances, and
    their dissimilarity (N,); one, other: (N, 3) vectors between each point and either centre."""
    out = np.empty((3, len(one)))
    _differences(one, other, out)
    return out[0], out[1], out[2]


def _starts(landmarks: Landmarks) -> np.ndarray:
    tracks = landmarks.tracks
    return np.searchsorted(tracks.points, np.arange(tracks.num_points + 1))


@_part
def _difference(ax, ay, az, bx, by, bz):
    """Cosine of the angle, ratio of lengths, and dissimilarity of two views of a point."""
    aa, bb = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz
    if aa < 1e-300 or bb < 1e-300:
        return -1.0, np.inf, np.inf
    cosine = (ax * bx + ay * by + az * bz) / np.sqrt(aa * bb)
    ratio = np.sqrt(bb / aa)
    return cosine, ratio, 2.0 * (1.0 - cosine) + 0.25 * np.log(ratio) ** 2


@_kernel
def _differences(one, other, out):
    for n in range(len(one)):
        a, b = one[n], other[n]
        found = _difference(a[0], a[1], a[2], b[0], b[1], b[2])
        out[0, n], out[1, n], out[2, n] = found


@_part
def _view_difference(point, one, other):
    """`_difference` of the views of a point from two centres."""
    x, y, z = point[0], point[1], point[2]
    return _difference(x - one[0], y - one[1], z - one[2], x - other[0], y - other[1], z - other[2])


@_part
def _reference(j, starts, frames, centres, points):
    """Row of the most central observation of point j."""
    best, row = np.inf, 0
    for a in range(starts[j], starts[j + 1]):
        cost = 0.0
        for b in range(starts[j], starts[j + 1]):
            cost += _view_difference(points[j], centres[frames[a]], centres[frames[b]])[2]
        if cost < best or a == starts[j]:
            best, row = cost, a
    return row


@_kernel
def _references(starts, frames, centres, points, out):
    for j in range(len(points)):
        out[j] = _reference(j, starts, frames, centres, points)


@_part
def _least(costs):
    """Index of the first of the least costs."""
    least = 0
    for k in range(1, len(costs)):
        if costs[k] < costs[least]:
            least = k
    return least


@_kernel
def _views(
    starts, frames, places, centres, points, rows, near, min_cosine, max_ratio, max_views, extended,
    out,
):  # fmt: skip
    listed = np.empty(len(centres), np.int64)  # last point that listed each frame
    seen = np.empty(len(centres), np.int64)  # last point that listed a frame of each place
    for frame in range(len(centres)):
        listed[frame] = seen[frame] = -1
    costs = np.empty(near.shape[1])
    num = 0
    for j in range(len(points)):
        if starts[j] == starts[j + 1]:
            continue
        host = frames[rows[j]]
        listed[host] = seen[places[host]] = j
        room = max_views
        for a in range(starts[j], starts[j + 1]):
            if listed[frames[a]] != j:
                listed[frames[a]] = j
                out[0, num], out[1, num] = j, frames[a]
                num += 1
                if seen[places[frames[a]]] != j:
                    seen[places[frames[a]]] = j
                    room -= 1
        if not extended[j]:
            continue
        for k in range(near.shape[1]):
            costs[k] = np.inf
            if seen[places[near[host, k]]] != j:
                cosine, ratio, cost = _view_difference(
                    points[j], centres[host], centres[near[host, k]]
                )
                if cosine > min_cosine and ratio < max_ratio and ratio * max_ratio > 1:
                    costs[k] = cost
        while room > 0:
            k = _least(costs)
            if costs[k] == np.inf:
                break
            costs[k] = np.inf
            out[0, num], out[1, num] = j, near[host, k]
            num += 1
            room -= 1
    return num
