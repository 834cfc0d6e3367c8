"""Observations of landmarks: families give them as terms, kernels read them sorted."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
from scipy.sparse import csr_matrix

from factors.compiled import kernel_and_part
from factors.landmark_residual import LandmarkResidual
from factors.robust import RobustLoss

_kernel, _ = kernel_and_part()


@_kernel
def frame_spans(frames, owners, first, last):
    """Lower `first` and raise `last` (J,) to the frames that observe each landmark."""
    for o in range(len(frames)):
        first[owners[o]] = min(first[owners[o]], frames[o])
        last[owners[o]] = max(last[owners[o]], frames[o])


@_kernel
def sort_by_owner(frames, owners, offsets, ends, order):
    """Rows of observations by landmark, then frame, then row.

    Landmark j gets order[offsets[j]:offsets[j + 1]]; `ends` (J,) begins as offsets[:-1]. Time is
    linear where the frames of a landmark ascend already.
    """
    for o in range(len(frames)):
        j = owners[o]
        at = ends[j]
        while at > offsets[j] and frames[order[at - 1]] > frames[o]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = o
        ends[j] += 1


BEARING, REPROJECTION, GIVEN = 0, 1, 2  # kinds of measurement; from GIVEN on one for each residual
# that others wrote
MIN_DEPTH = 1e-9  # z of a unit direction below which a point counts as behind the face

UNIT_TOLERANCE = 1e-6  # largest deviation of a bearing's length from one: residuals are angles only
# for unit bearings


class Observations(NamedTuple):
    """All observations of a block, sorted by landmark, then frame."""

    offsets: np.ndarray  # (J + 1,) int64: landmark j owns rows offsets[j]:offsets[j + 1]
    frames: np.ndarray  # (O,) int32, row of the poses
    kinds: np.ndarray  # (O,) uint8, BEARING, REPROJECTION, or GIVEN + row of functions
    families: np.ndarray  # (O,) uint8, family whose cost it counts to
    measurements: np.ndarray  # (O, 3): unit bearing, rig frame | u, v in pixels, row of cameras |
    # as the function takes it
    whiteners: np.ndarray  # (O, 3): [s00, s01, s11] of the upper triangular 2x2 sqrt information
    origins: np.ndarray  # (O, 3): where the ray starts, rig frame, map units
    cameras: np.ndarray  # (C, 12): [rig_R_face row-major (9), focal, principal u, v in pixels]
    functions: np.ndarray | None  # (G,) int64, addresses of residuals that others wrote; None =
    # there are none, and kernels are compiled without calls
    loss: int  # code of the robust loss
    loss_scale: float


class Visits(NamedTuple):
    """Visits of a run of landmarks by frames: one for each frame that observes a landmark."""

    first: int  # first landmark of the run
    offsets: np.ndarray  # (L + 1,) int64: landmark first + l owns visits offsets[l]:offsets[l + 1]
    frames: np.ndarray  # (V,) int32, ascending for each landmark
    owners: np.ndarray  # (V,) int32, landmark l of each visit
    row_offsets: np.ndarray  # (F + 1,) int64: frame f owns entries of by_frame
    by_frame: np.ndarray  # (V,) int32, visits sorted by frame, then landmark


class Term(Protocol):
    """Observations of one family, O of them, of the landmarks of a block."""

    @property
    def name(self) -> str:
        """Family that the cost is reported under."""
        ...

    @property
    def frames(self) -> np.ndarray:
        """(O,) int, row of the block's poses."""
        ...

    @property
    def points(self) -> np.ndarray:
        """(O,) int, row of the block's landmarks."""
        ...

    @property
    def kind(self) -> int | LandmarkResidual:
        """BEARING, REPROJECTION, or a residual that others wrote."""
        ...

    def measurements(self) -> np.ndarray:
        """(O, 3) rows as in Observations."""
        ...

    def whiteners(self) -> np.ndarray:
        """(O, 3) rows as in Observations."""
        ...

    def cameras(self) -> np.ndarray:
        """(C, 12) rows as in Observations; measurements index them from 0."""
        ...

    @property
    def origins_rig(self) -> np.ndarray | None:
        """(O, 3) rows as in Observations; None = the rig's own centre."""
        ...


def sort_observations(
    terms: Sequence[Term], num_frames: int, num_points: int, loss: RobustLoss
) -> tuple[Observations, np.ndarray, np.ndarray]:
    """Order landmarks by first and last frame, observations by landmark and frame. Returns these;
    the row of each among the terms back to back, (O,) int32; the original row of each landmark,
    (J,)."""
    lengths = [len(term.frames) for term in terms]
    frames = np.zeros(sum(lengths), dtype=np.int32)
    owners = np.zeros_like(frames)
    starts = np.cumsum([0, *lengths])
    spans = [slice(a, b) for a, b in pairwise(starts)]
    for term, span in zip(terms, spans, strict=True):
        frames[span], owners[span] = term.frames, term.points
    first = np.full(num_points, num_frames, dtype=np.int32)
    last = np.full(num_points, -1, dtype=np.int32)
    frame_spans(frames, owners, first, last)
    point_order = np.lexsort((last, first))
    rank = np.empty(num_points, dtype=np.int32)
    rank[point_order] = np.arange(num_points, dtype=np.int32)
    owners = rank[owners]
    offsets = np.zeros(num_points + 1, dtype=np.int64)
    np.cumsum(np.bincount(owners, minlength=num_points), out=offsets[1:])
    order = np.empty_like(frames)
    sort_by_owner(frames, owners, offsets, offsets[:-1].copy(), order)

    def ordered(columns: Iterable[np.ndarray]) -> np.ndarray:
        return np.concatenate([np.zeros((0, 3)), *columns]).take(order, axis=0)

    names = list(dict.fromkeys(term.name for term in terms))
    given = [term.kind.address for term in terms if not isinstance(term.kind, int)]
    kinds, families = np.zeros(len(frames), np.uint8), np.zeros(len(frames), np.uint8)
    measured, num_cameras = list[np.ndarray](), 0
    for term, span in zip(terms, spans, strict=True):
        kind, own = term.kind, len(term.cameras())
        # cameras are numbered on from those of the terms before
        rows = term.measurements()
        measured.append(rows + np.array([0, 0, num_cameras]) if own else rows)
        num_cameras += own
        kinds[span] = kind if isinstance(kind, int) else GIVEN + given.index(kind.address)
        families[span] = names.index(term.name)
    obs = Observations(
        offsets=offsets,
        frames=frames[order],
        kinds=kinds[order],
        families=families[order],
        measurements=ordered(measured),
        whiteners=ordered(term.whiteners() for term in terms),
        origins=ordered(
            np.zeros((len(term.frames), 3)) if term.origins_rig is None else term.origins_rig
            for term in terms
        ),
        cameras=np.concatenate([np.zeros((0, 12)), *(term.cameras() for term in terms)]),
        functions=np.array(given, dtype=np.int64) if given else None,
        loss=loss.code,
        loss_scale=float(loss.scale),
    )
    return obs, order, point_order


def visits_of(offsets: np.ndarray, frames: np.ndarray, num_frames: int, most: int) -> list[Visits]:
    """Visits of observations by landmark (offsets (J + 1,)), then frame (O,), cut into runs of
    landmarks of at most so many visits, exceeded by a run's last landmark only."""
    owners = np.repeat(np.arange(len(offsets) - 1, dtype=np.int32), np.diff(offsets))
    new = np.ones(len(frames), dtype=bool)
    new[1:] = (frames[1:] != frames[:-1]) | (owners[1:] != owners[:-1])
    owners, frames = owners[new], frames[new].astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(new)])[offsets]
    cuts = np.searchsorted(starts, np.arange(most, starts[-1], most))
    bounds = np.unique([0, *cuts, len(starts) - 1])
    runs = []
    for first, last in pairwise(bounds) if len(bounds) > 1 else [(0, 0)]:
        span = slice(starts[first], starts[last])
        row_offsets = np.zeros(num_frames + 1, dtype=np.int64)
        np.cumsum(np.bincount(frames[span], minlength=num_frames), out=row_offsets[1:])
        by_frame = np.argsort(frames[span], kind="stable").astype(np.int32)
        inner = (starts[first : last + 1] - starts[first]).astype(np.int64)
        own = owners[span] - np.int32(first)
        runs.append(Visits(int(first), inner, frames[span], own, row_offsets, by_frame))
    return runs


def covisible_pairs(
    offsets: np.ndarray, frames: np.ndarray, num_frames: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame pairs f < g with a common landmark, of observations by landmark (offsets (J + 1,),
    frames (O,)), as sorted CSR rows: starts (F + 1,) and columns (P,), int64; and the number of
    landmarks that each two share, (P,) float32."""
    num_points = len(offsets) - 1
    owners = np.repeat(np.arange(num_points), np.diff(offsets))
    ones = np.ones(len(owners), dtype=np.float32)
    seen = csr_matrix((ones, (frames, owners)), shape=(num_frames, num_points))
    shared = (seen @ seen.T).tocsr()
    shared.sort_indices()
    rows = np.repeat(np.arange(num_frames), np.diff(shared.indptr))
    upper = shared.indices > rows
    starts = np.zeros(num_frames + 1, dtype=np.int64)
    np.cumsum(np.bincount(rows[upper], minlength=num_frames), out=starts[1:])
    return starts, shared.indices[upper].astype(np.int64), shared.data[upper]


def check_term(term: Term, num_frames: int, num_points: int) -> None:
    """Refuse a term that is inconsistent with its block. ValueError: arrays have unequal lengths,
    indices are no integers or out of range, values not finite, or bearings not of length one."""
    frames, points = np.asarray(term.frames), np.asarray(term.points)
    rows = term.measurements()
    if not len(frames) == len(points) == len(rows):
        raise ValueError(
            f"term {term.name!r}: {len(frames)} frames, {len(points)} points and {len(rows)} "
            "measurements must be equal in number"
        )
    if len(frames) == 0:
        return
    if not (frames.dtype.kind in "iu" and points.dtype.kind in "iu"):
        raise ValueError(f"term {term.name!r}: indices of frames and points must be integers")
    if frames.min() < 0 or frames.max() >= num_frames:
        raise ValueError(f"term {term.name!r}: frame index out of range 0..{num_frames - 1}")
    if points.min() < 0 or points.max() >= num_points:
        raise ValueError(f"term {term.name!r}: point index out of range 0..{num_points - 1}")
    if not np.all(np.isfinite(rows)):
        raise ValueError(f"term {term.name!r}: measurements must be finite")
    if term.kind == BEARING and np.abs(np.linalg.norm(rows, axis=1) - 1).max() > UNIT_TOLERANCE:
        raise ValueError(f"term {term.name!r}: bearings must be of length one")
    origins = term.origins_rig
    if origins is not None and not (
        np.shape(origins) == (len(rows), 3) and np.isfinite(origins).all()
    ):
        raise ValueError(f"term {term.name!r}: origins must be finite, ({len(rows)}, 3)")
    num_cameras = len(term.cameras())
    if num_cameras and not (rows[:, 2].min() >= 0 and rows[:, 2].max() < num_cameras):
        raise ValueError(f"term {term.name!r}: face index out of range 0..{num_cameras - 1}")
