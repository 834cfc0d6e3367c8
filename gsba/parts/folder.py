"""A map in parts on disk: written from a stream of landmarks, which are never held all at once."""

import shutil
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np
from scipy.sparse import csr_array

from gsba.bundle.pose_variables import X
from gsba.disk import disk_errors
from gsba.log import GsbaError
from gsba.parts.partition import Partition, partition
from gsba.store.records import RecordError, load_record, save_record

T = TypeVar("T")

_INDEX = "index.npz"


@dataclass(frozen=True, slots=True)
class Sightings:
    """Landmarks, each with all of its observations; O observations of J landmarks."""

    frames: np.ndarray  # (O,) int32, of the map
    points: np.ndarray  # (O,) int32, rows of points_world
    bearings_rig: np.ndarray  # (O, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray  # (O,) float64, radians, per axis
    points_world: np.ndarray  # (J, 3) float64, start


@dataclass(frozen=True, slots=True)
class Part:
    """Frames, landmarks and factors that a part owns."""

    frames: np.ndarray  # (N,) int32, frames of the map: its own ones, then those on cuts
    num_kept: int  # K frames on cuts
    sightings: Sightings  # frames are rows of `frames`
    numbers: np.ndarray  # (J,) int64, place of each landmark in the stream
    graph: np.ndarray  # (B,) uint8, its other factors as GTSAM serializes them


@dataclass(frozen=True, slots=True)
class Index:
    """The parts of a map, and where its solution starts."""

    frames: np.ndarray  # (M,) int32, `Part.frames` of all parts, back to back
    starts: np.ndarray  # (P + 1,) int64, where those of each part begin
    num_kept: np.ndarray  # (P,) int64, frames on cuts of each
    poses: np.ndarray  # (F, 12) float64, rows [world_R_rig row-major, rig_in_world]

    def frames_of(self, part: int) -> np.ndarray:
        """`Part.frames` of a part."""
        return self.frames[self.starts[part] : self.starts[part + 1]]


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Part of a stream, or what a part owns of it."""

    sightings: Sightings
    numbers: np.ndarray  # (J,) int64
    graph: np.ndarray  # (B,) uint8


def part_folder(folder: Path, part: int) -> Path:
    """Folder of a part, in the map's."""
    return folder / f"part-{part:05d}"


def load_part(folder: Path, part: int) -> Part:
    """Read what a part owns.

    Raises:
        GsbaError: the file is missing or damaged.
    """
    return load(part_folder(folder, part) / "given.npz", Part)


def load_index(folder: Path) -> Index:
    """Read the parts of a map.

    Raises:
        GsbaError: the file is missing or damaged.
    """
    return load(folder / _INDEX, Index)


def load(path: Path, returns: type[T]) -> T:
    """Read a record of a map in parts.

    Raises:
        GsbaError: the file is missing or damaged.
    """
    try:
        return load_record(path, returns)
    except RecordError as error:
        raise GsbaError(f"{error}: write and solve the parts of this map again") from error


class PartsWriter:
    """Takes a stream of landmarks and factors, and writes them by parts."""

    def __init__(self, folder: Path) -> None:
        """Start in a folder; what an interrupted writer left there is deleted.

        Raises:
            GsbaError: the folder holds a map already, or something else.
        """
        if (folder / _INDEX).exists():
            raise GsbaError(f"{folder} holds the parts of a map: choose another folder")
        if folder.exists() and any(folder.iterdir()) and not (folder / "incoming").is_dir():
            raise GsbaError(f"{folder} is not empty: choose another folder")
        self._folder, self._incoming = folder, folder / "incoming"
        with disk_errors(folder):
            shutil.rmtree(folder, ignore_errors=True)
            self._incoming.mkdir(parents=True)
        self._codes = np.empty(0, np.int64)  # of pairs of frames, first << 32 | second
        self._num_chunks = self._num_points = 0

    def add(self, sightings: Sightings, graph: gtsam.NonlinearFactorGraph | None = None) -> None:
        """Take landmarks with all their observations, and factors on poses X(frame).

        Raises:
            GsbaError: the disk cannot be written, or a factor cannot (one written in Python).
        """
        graph = gtsam.NonlinearFactorGraph() if graph is None else graph
        numbers = self._num_points + np.arange(len(sightings.points_world))
        self._num_points += len(numbers)
        tied = [_covisible(sightings)]
        tied += [_codes_among(frames) for frames in _frames_of_factors(graph)]
        self._codes = np.unique(np.concatenate([self._codes, *tied]))
        chunk = _Chunk(sightings, numbers, _serialized(graph))
        save_record(self._incoming / f"{self._num_chunks:06d}.npz", chunk, {})
        self._num_chunks += 1

    def finish(self, poses: np.ndarray, most: int) -> Index:
        """Cut the map and write its parts.

        Args:
            poses: (F, 12) rows [world_R_rig row-major, rig_in_world] of all frames, to start from.
            most: frames of a part, without those on cuts.
        """
        pairs = np.column_stack([self._codes >> 32, self._codes & 0xFFFFFFFF])
        cut = partition(len(poses), pairs, most, poses[:, 9:])
        chunks: dict[int, int] = defaultdict(int)  # of each part so far
        for number in range(self._num_chunks):
            path = self._incoming / f"{number:06d}.npz"
            for part, chunk in _by_parts(load(path, _Chunk), cut):
                target = part_folder(self._folder, part)
                target.mkdir(exist_ok=True)
                save_record(target / f"chunk-{chunks[part]:06d}.npz", chunk, {})
                chunks[part] += 1
            path.unlink()
        written = [
            self._write_part(part, chunks[part], cut) for part in range(max(cut.num_parts, 1))
        ]
        frames = [part.frames for part in written]
        starts = np.concatenate([[0], np.cumsum([len(rows) for rows in frames])]).astype(np.int64)
        kept = np.array([part.num_kept for part in written], np.int64)
        index = Index(np.concatenate(frames), starts, kept, np.asarray(poses, np.float64))
        self._incoming.rmdir()
        save_record(self._folder / _INDEX, index, {})
        return index

    def _write_part(self, number: int, num_chunks: int, cut: Partition) -> "_Written":
        """Merge the chunks of a part."""
        folder = part_folder(self._folder, number)
        folder.mkdir(exist_ok=True)
        paths = [folder / f"chunk-{n:06d}.npz" for n in range(num_chunks)]
        chunks = [load(path, _Chunk) for path in paths]
        graph = gtsam.NonlinearFactorGraph()
        for chunk in chunks:
            graph.push_back(deserialized(chunk.graph))
        seen = [chunk.sightings.frames for chunk in chunks]
        seen += [np.array(list(frames)) for frames in _frames_of_factors(graph)]
        touched = np.unique(np.concatenate([np.empty(0, np.int64), *seen])).astype(np.int64)
        kept = touched[cut.on_cut[touched]]
        own = np.flatnonzero((cut.homes == number) & ~cut.on_cut)
        if not np.isin(touched[~cut.on_cut[touched]], own).all():
            raise RuntimeError(f"part {number} owns factors of another part's frames")
        frames = np.concatenate([own, kept]).astype(np.int32)
        local = np.empty(len(cut.homes), np.int32)
        local[frames] = np.arange(len(frames), dtype=np.int32)
        numbers = np.concatenate([np.empty(0, np.int64), *(chunk.numbers for chunk in chunks)])
        sightings = _merged([chunk.sightings for chunk in chunks], local)
        part = Part(frames, len(kept), sightings, numbers, _serialized(graph))
        save_record(folder / "given.npz", part, {})
        for path in paths:
            path.unlink()
        return _Written(frames, len(kept))


@dataclass(frozen=True, slots=True)
class _Written:
    """A part that was written."""

    frames: np.ndarray  # (N,) int32
    num_kept: int


def deserialized(graph: np.ndarray) -> gtsam.NonlinearFactorGraph:
    """Factors of a part."""
    out = gtsam.NonlinearFactorGraph()
    if len(graph):
        out.deserialize(graph.tobytes().decode("latin-1"))
    return out


def _serialized(graph: gtsam.NonlinearFactorGraph) -> np.ndarray:
    if not graph.size():
        return np.empty(0, np.uint8)
    try:
        return np.frombuffer(graph.serialize().encode("latin-1"), np.uint8)
    except RuntimeError as error:
        raise GsbaError(
            "a factor that is written in Python cannot be stored with the parts of a map: use "
            "GTSAM's own factors"
        ) from error


def _frames_of_factors(graph: gtsam.NonlinearFactorGraph) -> list[set[int]]:
    """Frames that each factor is about."""
    keys = [graph.at(i).keys() for i in range(graph.size())]
    return [{gtsam.Symbol(key).index() for key in of_factor} for of_factor in keys]


def _codes_among(frames: set[int]) -> np.ndarray:
    """Codes of all pairs of a few frames."""
    rows = np.array(sorted(frames), np.int64)
    i, j = np.triu_indices(len(rows), 1)
    return rows[i] << 32 | rows[j]


def _covisible(sightings: Sightings) -> np.ndarray:
    """Codes (P,) of frame pairs with a common landmark."""
    if not len(sightings.frames):
        return np.empty(0, np.int64)
    frames, local = np.unique(sightings.frames, return_inverse=True)
    ones = np.ones(len(local), np.float32)
    shape = len(frames), len(sightings.points_world)
    seen = csr_array((ones, (local, sightings.points)), shape=shape)
    shared = (seen @ seen.T).tocoo()
    upper = shared.row < shared.col
    wide = frames.astype(np.int64)
    return wide[shared.row[upper]] << 32 | wide[shared.col[upper]]


def _by_parts(chunk: _Chunk, cut: Partition) -> list[tuple[int, _Chunk]]:
    """Landmarks and factors of a chunk, by the part that owns them."""
    sightings, graph = chunk.sightings, deserialized(chunk.graph)
    num = len(sightings.points_world)
    owners = cut.owners(sightings.frames.astype(np.int64), sightings.points, num)
    factors: dict[int, gtsam.NonlinearFactorGraph] = defaultdict(gtsam.NonlinearFactorGraph)
    for i, frames in enumerate(_frames_of_factors(graph)):
        rows = np.array(sorted(frames), np.int64)
        owner = int(cut.owners(rows, np.zeros(len(rows), np.int64), 1)[0])
        factors[owner].push_back(graph.at(i))
    out = []
    for part in sorted({*np.unique(owners).tolist(), *factors}):
        mine = owners == part
        chosen = mine[sightings.points]
        local = (np.cumsum(mine) - 1).astype(np.int32)
        own = Sightings(
            sightings.frames[chosen],
            local[sightings.points[chosen]],
            sightings.bearings_rig[chosen],
            sightings.sigmas_rad[chosen],
            sightings.points_world[mine],
        )
        graph_of = _serialized(factors.get(part, gtsam.NonlinearFactorGraph()))
        out.append((part, _Chunk(own, chunk.numbers[mine], graph_of)))
    return out


def _merged(chunks: list[Sightings], local: np.ndarray) -> Sightings:
    """Sightings one behind the other, frames replaced by `local` ones."""
    empty = np.empty(0, np.int32)
    firsts = np.cumsum([0, *(len(chunk.points_world) for chunk in chunks)])
    points = [chunk.points + np.int32(n) for chunk, n in zip(chunks, firsts, strict=False)]
    return Sightings(
        local[np.concatenate([empty, *(chunk.frames for chunk in chunks)])],
        np.concatenate([empty, *points]).astype(np.int32),
        np.concatenate([np.empty((0, 3)), *(chunk.bearings_rig for chunk in chunks)]),
        np.concatenate([np.empty(0), *(chunk.sigmas_rad for chunk in chunks)]),
        np.concatenate([np.empty((0, 3)), *(chunk.points_world for chunk in chunks)]),
    )


def values_at(frames: np.ndarray, poses: np.ndarray) -> gtsam.Values:
    """Variables X(frame) of frames (N,) at pose rows (N, 12)."""
    values = gtsam.Values()
    for frame, row in zip(frames.tolist(), poses, strict=True):
        rotation = gtsam.Rot3(row[:9].reshape(3, 3))
        values.insert(X(frame), gtsam.Pose3(rotation, row[9:]))
    return values
