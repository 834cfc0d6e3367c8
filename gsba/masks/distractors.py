"""Detection of moving objects from a solved map: pixels that no static scene explains.

A panorama is compared with its neighbours through their solved poses, at a range of distances
bounded by the map's points around each direction (a plane sweep, Collins, CVPR 1996). Static scene
agrees with several neighbours at some distance. Moving objects agree with hardly any, while those
agree with one another on the background. A pixel is marked only if enough neighbours could have
seen it.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from gsba.camera.sphere import around_seam, erp_directions, erp_from_bearings
from gsba.frames import panorama
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.geometry import inverse
from gsba.masks import _distractor_kernels
from gsba.store.shards import StoredRecords
from gsba.store.store import PerFrame
from gsba.types import FrameSet, Landmarks, Tracks

_WIDTH_PX = 512  # pixels across the panoramas that are compared
_MIN_WITNESSES = 3  # least number of neighbours that can mark a pixel
_MIN_SHARED_POINTS = 30  # least number of shared points of a neighbour
_REACH_CELLS = 3  # cells around a direction whose points bound its distance
_EMPTY_CELL = np.float32(-1e9)  # value of a cell without points
_PATCH_PX = 5  # pixels over which differences are averaged
_MAX_DIFFERENCE = 60.0  # grey levels at which differences are clipped
_WEAK_DIFFERENCE, _STRONG_DIFFERENCE = 5.0, 14.0  # grey levels: of all pixels of a distractor, and
# of at least some of them
_MIN_WIDTH_PX = 5  # pixels: narrower regions are edges
_CLOSING_PX = 13  # pixels: gaps up to this are closed
_DILATION_PX = 5  # pixels added: the rim is blurred, and a splat shows any remainder
_MAX_SHARE = 0.35  # share of a picture: more is a wrong pose, or changed light
_NUM_LEVELS = 15  # levels of a stored weight
_WRAP_PX = 32  # pixels padded over the seam
_wrapped = partial(around_seam, columns=_WRAP_PX)


@dataclass(frozen=True, slots=True)
class Distractors:
    """The distractors found in one frame."""

    weights: np.ndarray  # compressed (h, 2h) 0..1, 0 = distractor; see `distractor_weights`
    share: float  # of the sphere that distractors cover
    reason: str  # why the frame was not searched, or ""


def distractor_weights(found: Distractors) -> np.ndarray:
    """Weights of pixels, (h, 2h) float32, 0..1, 0 = distractor."""
    levels = np.asarray(cv2.imdecode(found.weights, cv2.IMREAD_GRAYSCALE), np.float32)
    return levels / _NUM_LEVELS


def distractor_mask(found: Distractors) -> np.ndarray:
    """(h, 2h) bool, True = distractor."""
    return distractor_weights(found) == 0


@dataclass(frozen=True, slots=True)
class KnownMasks:
    """Distractors of an earlier pass, (h, 2h) bool by frame."""

    found: PerFrame[Distractors]
    names: tuple[str, ...]  # (F,)

    def __call__(self, frame: int) -> np.ndarray:
        return distractor_mask(self.found[self.names[frame]])

    def taken(self, chosen: Sequence[int]) -> Callable[[int], np.ndarray]:
        """The masks of some frames, renumbered, read from files alone by other processes."""
        records = self.found.records({n: self.names[f] for n, f in enumerate(chosen)})
        return partial(_stored_mask, records)


def _stored_mask(records: StoredRecords[Distractors], frame: int) -> np.ndarray:
    return distractor_mask(records(frame))


class StaticScene:
    """A solved map, prepared to search frames of any layout one by one, from any thread.

    Masked pixels are neither compared nor marked, nor are distractors (h, w) bool of a frame found
    before, which stay marked where too few neighbours are left to judge. Small pictures are kept in
    memory up to a limit in MB; the others are read again. neighbours: of frames to search, if other
    frames are left out. colours: False compares grey levels, None does where some frames are cube
    faces, of which there are no others.
    """

    def __init__(
        self,
        frames: FrameSet,
        world_T_rigs: np.ndarray,
        landmarks: Landmarks,
        known: Callable[[int], np.ndarray] | None = None,
        limit_mb: float = 256.0,
        neighbours: Mapping[int, np.ndarray] | None = None,
        colours: bool | None = None,
    ) -> None:
        self._frames, self._poses, self._landmarks = frames, world_T_rigs, landmarks
        self._limit_mb, self._known_neighbours = limit_mb, neighbours or {}
        self.width = min(
            (min(_WIDTH_PX, kind.width) if kind.panoramic else panorama.width_for(kind, _WIDTH_PX))
            for kind in frames.formats
        )
        self._known, self._rays = known, erp_directions(self.width).astype(np.float32)
        self._colours = all(k.panoramic for k in frames.formats) if colours is None else colours
        self._room = int(limit_mb * 2**20 / (1.5 * self.width**2))
        self._kept: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()
        tracks = landmarks.tracks
        order = np.argsort(tracks.frames, kind="stable")
        starts = np.searchsorted(tracks.frames[order], np.arange(len(frames) + 1))
        self._seen = [np.unique(tracks.points[order[a:b]]) for a, b in pairwise(starts)]

    def __reduce__(self) -> tuple[object, ...]:  # workers read pictures again
        own = self._frames, self._poses, self._landmarks, self._known
        return StaticScene, (*own, self._limit_mb, self._known_neighbours, self._colours)

    def taken(self, chosen: Sequence[int]) -> tuple["StaticScene", dict[int, int]]:
        """The part of the scene that some frames need, for other processes, and the index in it of
        each."""
        near = {frame: self._neighbours(frame) for frame in chosen}
        rows = np.unique(np.concatenate([np.array(chosen, np.int64), *near.values()]))
        number = {int(row): n for n, row in enumerate(rows)}
        tracks = self._landmarks.tracks
        shown = np.isin(tracks.frames, rows)
        points, renumbered = np.unique(tracks.points[shown], return_inverse=True)
        own_frames = np.searchsorted(rows, tracks.frames[shown]).astype(np.int32)
        own = Tracks(renumbered.astype(np.int32), own_frames, tracks.keypoints[shown], len(points))
        places = self._landmarks.points_world[points]
        known = self._known
        if isinstance(known, KnownMasks):
            known = known.taken(rows.tolist())
        scene = StaticScene(
            self._frames.taken(rows, absolute=True),
            self._poses[rows],
            Landmarks(places, own, self._landmarks.counts),
            known,
            self._limit_mb,
            {number[f]: np.searchsorted(rows, others) for f, others in near.items()},
            self._colours,
        )
        return scene, number

    def find(self, frame: int) -> Distractors:
        """Distractors in one frame."""
        shape = (self.width // 2, self.width)
        near = self._neighbours(frame)
        if len(near) < _MIN_WITNESSES:
            return _packed(np.ones(shape), "too few frames share points with it")
        own = self._picture(frame)
        usable = own[..., 0] >= 0
        others = np.stack([self._exposed(n, frame, own) for n in near])
        n_T_own = (inverse(self._poses[near]) @ self._poses[frame]).astype(np.float32)
        points = np.unique(np.concatenate([self._seen[f] for f in (frame, *near)]))
        width = self.width // 8
        pixels, distances = self._pixels(frame, points, width)
        u, v = pixels.T
        logs = -np.log(distances).astype(np.float32)
        high = np.full((width // 2, width), _EMPTY_CELL, np.float32)
        low = high.copy()  # of the negative, so that both are maxima
        np.maximum.at(high, (v, u), logs)
        np.maximum.at(low, (v, u), -logs)
        high, low = _spread_out(high), _spread_out(low)
        size = (self.width, self.width // 2)
        margin = np.float32(np.log(1.4))  # beyond the nearest and furthest points
        lowest, highest = -cv2.resize(low, size) - margin, cv2.resize(high, size) + margin
        middle = np.exp(0.5 * (lowest + highest)).astype(np.float32)
        seen = _distractor_kernels.witnesses(others[..., 0] >= 0, n_T_own, self._rays, middle)
        score = _score(own, others, n_T_own, self._rays, lowest, highest)
        unjudged = seen < min(_MIN_WITNESSES, len(near))
        score[unjudged | ~usable] = 0
        noise = max(1.0, float(np.median(score)))
        wide = _wrapped(score)
        weak = cv2.morphologyEx(
            (wide > noise * _WEAK_DIFFERENCE).astype(np.uint8),
            cv2.MORPH_OPEN,
            np.ones((_MIN_WIDTH_PX, _MIN_WIDTH_PX), np.uint8),
        )
        num, parts = cv2.connectedComponents(weak, connectivity=4)
        labels = np.asarray(parts, np.int32)
        rows = (np.arange(len(wide)) + 0.5) / len(wide)
        areas = np.broadcast_to(np.sin(np.pi * rows)[:, None], wide.shape)
        strong = (weak > 0) & (wide > noise * _STRONG_DIFFERENCE)
        sums = np.bincount(labels[strong], weights=areas[strong], minlength=num)
        sums[0] = 0
        found = (sums >= 120)[labels].astype(np.uint8)  # strong pixels at the equator
        ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_CLOSING_PX, _CLOSING_PX))
        found = cv2.morphologyEx(found, cv2.MORPH_CLOSE, ellipse)
        outlines, _ = cv2.findContours(found, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(found, outlines, -1, 1, cv2.FILLED)
        grown = cv2.dilate(found, np.ones((_DILATION_PX, _DILATION_PX), np.uint8))
        found = _unwrapped(grown) > 0
        if self._known is not None:  # marked in the first pass, with no neighbour left to judge
            found |= self._known(frame) & unjudged
        found &= usable
        if np.median(score) > 5.0 or _share(found) > _MAX_SHARE:  # grey levels
            return _packed(np.ones(shape), "fits no neighbour: its pose or light is off")
        return _packed(np.where(found, 0, 1 / (1 + (score / (noise * _WEAK_DIFFERENCE)) ** 2)), "")

    def _neighbours(self, frame: int) -> np.ndarray:
        """The frames that share the most points, most first."""
        if frame in self._known_neighbours:
            return self._known_neighbours[frame]
        inside = np.zeros(len(self._landmarks.points_world), bool)
        inside[self._seen[frame]] = True
        shared = np.array([np.count_nonzero(inside[seen]) for seen in self._seen])
        shared[frame] = 0
        best = np.argsort(-shared, kind="stable")[:6]
        return best[shared[best] >= _MIN_SHARED_POINTS]

    def _picture(self, frame: int) -> np.ndarray:
        """Small panorama (h, w, C) float32, negative where masked."""
        kept = self._kept.get(frame)
        if kept is None:
            kept = _load(self._frames, frame, self.width, self._colours)
            with self._lock:
                self._kept[frame] = kept
                while len(self._kept) > max(self._room, 1):
                    self._kept.pop(next(iter(self._kept)))
        picture = kept[..., :-1].astype(np.float32)
        picture[kept[..., -1] == 0] = -1.0
        return picture

    def _exposed(self, other: int, frame: int, own: np.ndarray) -> np.ndarray:
        """A neighbour's picture scaled to the exposure of a frame, by their shared points."""
        picture = self._picture(other)
        if self._known is not None:
            picture[self._known(other)] = -1.0
        points = np.intersect1d(self._seen[frame], self._seen[other], assume_unique=True)
        a, b = self._colors(own, frame, points), self._colors(picture, other, points)
        good = (a.min(axis=1) > 0) & (b.min(axis=1) > 0)
        if np.count_nonzero(good) >= _MIN_SHARED_POINTS // 2:
            gain = np.median(a[good] / b[good], axis=0)
            picture = np.where(picture < 0, -1.0, np.clip(gain, 0.4, 2.5) * picture)
        return picture.astype(np.float32)

    def _colors(self, picture: np.ndarray, frame: int, points: np.ndarray) -> np.ndarray:
        """Colours (P, C) of points in a frame's picture."""
        u, v = self._pixels(frame, points, self.width)[0].T
        return picture[v, u]

    def _pixels(self, frame: int, points: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (P, 2) int64 of points in a panorama of some width, and their distances (P,)."""
        pose = self._poses[frame]
        local = (self._landmarks.points_world[points] - pose[:3, 3]) @ pose[:3, :3]
        uv = erp_from_bearings(local, width, width // 2).astype(np.int64)
        uv[:, 0] %= width
        uv[:, 1] = np.clip(uv[:, 1], 0, width // 2 - 1)
        return uv, np.maximum(np.linalg.norm(local, axis=1), 1e-9)


def _load(frames: FrameSet, frame: int, width: int, colours: bool) -> np.ndarray:
    """Small picture (h, w, C + 1) uint8: colours of a panorama, or grey, and the mask."""
    kind = frames.format_of(frame)
    if kind.panoramic:
        color = load_erp(frames, frame, not colours, width)
        mask = load_mask(frames, frame)
        use = np.ones(color.shape[:2], np.uint8)
        if mask is not None:
            use = panorama.fit_mask(mask, width).astype(np.uint8)
        return np.dstack([color, use])
    grey, mask = panorama.load_grey(frames, frame, width)
    use = np.ones_like(grey) if mask is None else mask.astype(np.uint8)
    return np.dstack([grey, use])


def _spread_out(cells: np.ndarray) -> np.ndarray:
    """Maxima over the cells around each (h, w), then outward until no cell is empty."""
    window = np.ones((2 * _REACH_CELLS + 1, 2 * _REACH_CELLS + 1), np.uint8)

    def widened(a: np.ndarray) -> np.ndarray:
        spread = cv2.dilate(around_seam(a, _REACH_CELLS), window)
        return np.maximum(spread[:, _REACH_CELLS:-_REACH_CELLS], _EMPTY_CELL)

    cells = widened(cells)
    while (cells <= _EMPTY_CELL).any():
        cells = np.where(cells <= _EMPTY_CELL, widened(cells), cells)
    return cells


def _score(
    own: np.ndarray,
    others: np.ndarray,
    n_T_own: np.ndarray,
    rays: np.ndarray,
    lowest: np.ndarray,
    highest: np.ndarray,
) -> np.ndarray:
    """Grey levels (h, w) by which no distance explains a pixel in two neighbours, or in three that
    agree on something else."""
    num, shape = len(others), own.shape[:2]
    kernel = np.ones((3, 3), np.uint8)
    least, most = (op(_wrapped(own), kernel) for op in (cv2.erode, cv2.dilate))
    least, most = (np.ascontiguousarray(_unwrapped(x)).reshape(own.shape) for x in (least, most))
    differences = np.empty((num, *shape), np.float32)
    away, spread = np.empty(shape, np.float32), np.empty(shape, np.float32)
    best = np.full((2, *shape), _MAX_DIFFERENCE, np.float32)
    away_best, spread_best = (
        np.zeros(shape, np.float32),
        np.full(shape, 2 * _MAX_DIFFERENCE, np.float32),
    )
    nearest, furthest = np.exp(highest), np.exp(lowest)
    for step in np.linspace(0, 1, 18, dtype=np.float32):  # even steps in the pictures
        assumed = (1 - step) * nearest + step * furthest
        _distractor_kernels.compare(
            own, least, most, others, n_T_own, rays, assumed, np.float32(_MAX_DIFFERENCE),
            differences, away, spread,
        )  # fmt: skip
        smooth = np.stack([_averaged(differences[n]) for n in range(num)])
        _distractor_kernels.keep_best(
            smooth, _averaged(away), _averaged(spread), best, away_best, spread_best
        )
    # a pixel must differ from its neighbours' median by two of their spreads
    contradicted = 0.5 * (away_best - 2.0 * spread_best)
    return np.maximum(best[0], np.minimum(best[1], contradicted))


def _packed(weights: np.ndarray, reason: str) -> Distractors:
    levels = np.where(weights > 0, np.maximum(np.rint(_NUM_LEVELS * weights), 1), 0).astype(
        np.uint8
    )
    return Distractors(cv2.imencode(".png", levels)[1].ravel(), _share(weights == 0), reason)


def _share(found: np.ndarray) -> float:
    """Part of the sphere."""
    weights = np.sin(np.pi * (np.arange(len(found)) + 0.5) / len(found))
    return float(found.mean(axis=1) @ weights / weights.sum())


def _unwrapped(image: np.ndarray) -> np.ndarray:
    return image[:, _WRAP_PX:-_WRAP_PX]


def _averaged(image: np.ndarray) -> np.ndarray:
    return _unwrapped(
        cv2.blur(_wrapped(image), (_PATCH_PX, _PATCH_PX), borderType=cv2.BORDER_REPLICATE)
    )


@dataclass(frozen=True, slots=True)
class Look:
    """Finds the distractors of a frame by its name."""

    scene: StaticScene
    numbers: Mapping[str, int]  # of the scene's frames

    def __call__(self, name: str) -> Distractors:
        return self.scene.find(self.numbers[name])

    def taken(self, names: Sequence[str]) -> "Look":
        """The part that some frames need, see `gsba.store.store.Taken`."""
        scene, number = self.scene.taken([self.numbers[name] for name in names])
        return Look(scene, {name: number[self.numbers[name]] for name in names})
