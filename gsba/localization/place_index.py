"""Index of a map's places: global descriptors of keyframes and their faces, kept beside the run."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsba.camera.rig import cells_of
from gsba.localization.run_map import RunMap
from gsba.log import GsbaError, track
from gsba.loop_closure.retrieval import aggregate, visual_words
from gsba.matching.guided_search import SearchableFrames
from gsba.store.folder import STAGES
from gsba.store.records import FORMAT, RecordError, load_checkpoint, read_info, save_record
from gsba.store.shards import Threads
from gsba.store.store import digest
from gsba.types import FACES
from gsba.types.records import slices
from gsba.version import __version__

logger = logging.getLogger(__name__)

T = TypeVar("T")

_LEVELS = 127  # of a component of a stored descriptor, to either side of zero


@dataclass(frozen=True, slots=True)
class PlaceIndex:
    """Global descriptors of a map's keyframes, quantised; similarity is their inner product."""

    words: np.ndarray  # (W, D) float32, vocabulary
    panoramas: np.ndarray  # (F, W D) int8, of whole keyframes
    faces: np.ndarray  # (F, 6, W D) int8, of the keypoints of each face; zero = too few
    panorama_scales: np.ndarray  # (F,) float32, of one level
    face_scales: np.ndarray  # (F, 6) float32

    def nearest_panoramas(self, descriptors: np.ndarray, most: int) -> np.ndarray:
        """Keyframes (N,) whose whole panoramas look most like descriptors (K, D) of a panorama."""
        alike = self._products(self.panoramas, descriptors) * self.panorama_scales
        return np.argsort(-alike, kind="stable")[:most]

    def nearest_faces(self, descriptors: np.ndarray, most: int) -> np.ndarray:
        """Keyframes (N,) with a face that looks most like descriptors (K, D) of a picture."""
        flat = self.faces.reshape(-1, self.faces.shape[2])
        alike = self._products(flat, descriptors).reshape(self.face_scales.shape)
        return np.argsort(-(alike * self.face_scales).max(axis=1), kind="stable")[:most]

    def _products(self, rows: np.ndarray, descriptors: np.ndarray) -> np.ndarray:
        """Inner products (N,) of int8 rows (N, W D) with the aggregate of descriptors (K, D)."""
        look = aggregate(descriptors, self.words).astype(np.float32)
        blocks = [rows[some].astype(np.float32) @ look for some in slices(len(rows), 512)]
        return np.concatenate(blocks)


def load_or_make(map_: RunMap, path: Path, kind: type[T], make: Callable[[], T]) -> T:
    """Load a record that depends on a map's run alone; make and save it if this run has none."""
    try:
        info = read_info(map_.root / STAGES / "reconstruction.npz")
    except RecordError as error:  # it was read a moment ago
        raise GsbaError(f"{map_.root} changed while it was read: run again") from error
    key = digest(__version__, FORMAT, info.get("key", ""), map_.frames.names, map_.settings.seed)
    found = load_checkpoint(path, key, kind, "the map is indexed again")
    if found is not None:
        return found
    made = make()
    try:
        save_record(path, made, {"key": key})
    except GsbaError as error:
        logger.warning("the index of the map is not kept: %s", error)
    return made


def index_path(root: Path) -> Path:
    """File of a run's index: in a folder beside the run, which stays as it is."""
    root = root.resolve()
    return root.with_name(f"{root.name}-index") / "places.npz"


def make_index(map_: RunMap) -> PlaceIndex:
    """Global descriptors of the keyframes of a map."""
    num = len(map_.frames)
    frames = SearchableFrames(lambda f: map_.load_keyframe(f).features, axes=map_.axes)
    words = visual_words(frames, num, map_.settings.seed, Threads(1))
    size = words.size
    panoramas, faces = np.zeros((num, size), np.int8), np.zeros((num, len(FACES), size), np.int8)
    scales, face_scales = np.zeros(num, np.float32), np.zeros((num, len(FACES)), np.float32)
    for f in track(range(num), "indexing the map", num):
        found = frames[f]
        panoramas[f], scales[f] = _quantised(aggregate(found.descriptors, words))
        owners = cells_of(found.bearings.astype(np.float64), 1)
        for face in range(len(FACES)):
            own = found.descriptors[owners == face]
            if len(own) >= 8:  # keypoints without which a face has no descriptor
                faces[f, face], face_scales[f, face] = _quantised(aggregate(own, words))
    return PlaceIndex(words, panoramas, faces, scales, face_scales)


def _quantised(look: np.ndarray) -> tuple[np.ndarray, float]:
    """Levels (D,) int8 of a descriptor, and the size of one."""
    scale = float(np.abs(look).max()) / _LEVELS or 1.0
    return np.rint(look / scale).astype(np.int8), scale
