"""A map in parts on disk: written from a stream of landmarks, which are never held all at once."""

import shutil
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np
from scipy.sparse import csr_array

from factors import Term
from gsba.bundle.families import kept, restored
from gsba.bundle.pose_variables import X
from gsba.disk import disk_errors
from gsba.log import GsbaError
from gsba.parts.observations import NotStorableError, ObservedRows, TermRows, merged
from gsba.parts.partition import Partition, partition
from gsba.store.records import RecordError, load_record, save_record
from gsba.types import FamilyVariables

T = TypeVar("T")

_INDEX = "index.npz"
_BLOCK = 6  # coordinates of a node
_BESIDE = 1 << 30  # first number of variables that are no frames, while a map is written
_FRAME = gtsam.symbolChr(X(0))


@dataclass(frozen=True, slots=True)
class At:
    """Values of variables: poses of frames, and variables of families."""

    poses: np.ndarray  # (F, 12) float64, rows [world_R_rig row-major, rig_in_world]
    beside: FamilyVariables  # V of them

    @classmethod
    def of(cls, values: gtsam.Values, frames: Iterable[int], keys: Sequence[int]) -> "At":
        """Some of the values: poses of these frames, and variables of these keys."""
        matrices = [values.atPose3(X(frame)).matrix() for frame in frames]
        poses = np.array(matrices).reshape(-1, 4, 4)
        rows = np.hstack([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]])
        return cls(rows, kept(values, keys))

    def values(self, frames: Iterable[int]) -> gtsam.Values:
        """The variables under their keys; `frames` are those of the poses."""
        values = values_at(frames, self.poses)
        values.insert(restored(self.beside))
        return values


@dataclass(frozen=True, slots=True)
class MapPart:
    """Frames, landmarks and factors that a part owns.

    A node is 6 coordinates of a variable: those of the frames come first in the map, then those of
    other variables, in the order of their keys.
    """

    frames: np.ndarray  # (N,) int32, frames of the map: its own ones, then those on cuts
    keys: np.ndarray  # (M,) int64, of all its variables: its own ones, then those on cuts
    num_kept: int  # K nodes of variables on cuts
    sightings: ObservedRows  # frames are rows of `frames`
    numbers: np.ndarray  # (J,) int64, place of each landmark in the stream
    graph: np.ndarray  # (B,) uint8, its other factors as GTSAM serializes them

    @property
    def beside(self) -> list[int]:
        """Keys of variables that are no frames, in the order of `keys`."""
        return [int(key) for key in self.keys if gtsam.symbolChr(int(key)) != _FRAME]


@dataclass(frozen=True, slots=True)
class Index:
    """The parts of a map, and where its solution starts."""

    nodes: np.ndarray  # (M,) int64, nodes of all parts, back to back: own ones, then those on cuts
    starts: np.ndarray  # (P + 1,) int64, where those of each part begin
    num_kept: np.ndarray  # (P,) int64, nodes on cuts of each
    start: At  # of all frames, and of other variables

    def nodes_of(self, part: int) -> np.ndarray:
        """Nodes of a part, its own ones first."""
        return self.nodes[self.starts[part] : self.starts[part + 1]]


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Part of a stream, or what a part owns of it."""

    sightings: ObservedRows
    numbers: np.ndarray  # (J,) int64
    graph: np.ndarray  # (B,) uint8


def part_folder(folder: Path, part: int) -> Path:
    """Folder of a part, in the map's."""
    return folder / f"part-{part:05d}"


def load_part(folder: Path, part: int) -> MapPart:
    """Read what a part owns."""
    return load(part_folder(folder, part) / "given.npz", MapPart)


def load_index(folder: Path) -> Index:
    """Read the parts of a map."""
    return load(folder / _INDEX, Index)


def has_index(folder: Path) -> bool:
    """True if all parts of a map were written to the folder."""
    return (folder / _INDEX).exists()


def remove_map(folder: Path) -> None:
    """Delete a map in parts, its index first: what is left by an interruption is no map."""
    with disk_errors(folder):
        (folder / _INDEX).unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)


def keys_beside(values: gtsam.Values) -> list[int]:
    """Keys of variables that are no frames."""
    return [key for key in values.keys() if gtsam.symbolChr(key) != _FRAME]  # noqa: SIM118


def load(path: Path, returns: type[T]) -> T:
    """Read a record of a map in parts; GsbaError if it is missing or damaged."""
    try:
        return load_record(path, returns)
    except RecordError as error:
        raise GsbaError(f"{error}: write and solve the parts of this map again") from error


class PartsWriter:
    """Takes a stream of landmarks and factors, and writes them by parts."""

    def __init__(self, folder: Path) -> None:
        """Start in a folder; what an interrupted writer left there is deleted. Raises GsbaError:
        the folder holds a map already, or something else."""
        if has_index(folder):
            raise GsbaError(f"{folder} holds the parts of a map: choose another folder")
        if folder.exists() and any(folder.iterdir()) and not (folder / "incoming").is_dir():
            raise GsbaError(f"{folder} is not empty: choose another folder")
        self._folder, self._incoming = folder, folder / "incoming"
        with disk_errors(folder):
            shutil.rmtree(folder, ignore_errors=True)
            self._incoming.mkdir(parents=True)
        self._codes = np.empty(0, np.int64)  # of pairs of variables, first << 32 | second
        self._numbers: dict[int, int] = {}  # of variables that are no frames, by key
        self._ties = np.empty((0, 2), np.int64)
        self._num_chunks = self._num_points = 0

    def add(
        self,
        points_world: np.ndarray,
        terms: Sequence[Term],
        graph: gtsam.NonlinearFactorGraph | None = None,
    ) -> None:
        """Take landmarks with all their observations, and factors.

        Args:
            points_world: (J, 3) float64, landmarks to start from.
            terms: observations by terms of `factors`, as `factors.LandmarkBlock` takes them; frames
                are those of the map.
            graph: GTSAM's own factors on poses X(frame), and on other variables if need be.

        Raises:
            GsbaError: the disk cannot be written.
            NotStorableError: a factor or a residual cannot be stored (one written in Python).
        """
        graph = gtsam.NonlinearFactorGraph() if graph is None else graph
        sightings = ObservedRows(
            tuple(map(TermRows.of, terms)), np.asarray(points_world, np.float64)
        )
        numbers = self._num_points + np.arange(len(sightings.points_world))
        self._num_points += len(numbers)
        tied = [_covisible(sightings)]
        for numbers_of in map(self._variables, _keys_of_factors(graph)):
            i, j = np.triu_indices(len(numbers_of), 1)
            tied.append(numbers_of[i] << 32 | numbers_of[j])
        self._codes = np.unique(np.concatenate([self._codes, *tied]))
        chunk = _Chunk(sightings, numbers, serialized(graph))
        save_record(self._incoming / f"{self._num_chunks:06d}.npz", chunk, {})
        self._num_chunks += 1

    def tie(self, pairs: np.ndarray) -> None:
        """Let a part have both of each of these pairs (P, 2) of frames, for their covariances."""
        self._ties = np.sort(np.asarray(pairs, np.int64), axis=1)
        first, second = self._ties.T
        self._codes = np.unique(np.concatenate([self._codes, first << 32 | second]))

    def cut(self, values: gtsam.Values, num_frames: int, most: int) -> Partition:
        """Cut what was added into parts of at most `most` variables off the cuts; gives the part of
        each frame, then of each other variable."""
        pairs = np.column_stack([self._codes >> 32, self._codes & 0xFFFFFFFF])
        pairs = np.where(pairs < _BESIDE, pairs, pairs - _BESIDE + num_frames)
        num, poses = num_frames + len(self._numbers), At.of(values, range(num_frames), ()).poses
        return partition(num, pairs, most, _places(poses[:, 9:], pairs, num))

    def finish(self, values: gtsam.Values, num_frames: int, cut: Partition) -> Index:
        """Write the parts of a map, as `cut` has cut it."""
        keys, dims = list(self._numbers), values.dims()
        start = At.of(values, range(num_frames), keys)
        variables = _Variables(num_frames, keys, [dims[key] for key in keys])
        chunks: dict[int, int] = defaultdict(int)  # of each part so far
        for number in range(self._num_chunks):
            path = self._incoming / f"{number:06d}.npz"
            for part, chunk in self._by_parts(load(path, _Chunk), cut, variables):
                target = part_folder(self._folder, part)
                target.mkdir(exist_ok=True)
                save_record(target / f"chunk-{chunks[part]:06d}.npz", chunk, {})
                chunks[part] += 1
            path.unlink()
        written = [
            self._write_part(part, chunks[part], cut, variables)
            for part in range(max(cut.num_parts, 1))
        ]
        nodes = [rows for rows, _ in written]
        starts = np.concatenate([[0], np.cumsum([len(rows) for rows in nodes])]).astype(np.int64)
        num_kept = np.array([num for _, num in written], np.int64)
        index = Index(np.concatenate(nodes), starts, num_kept, start)
        save_record(self._folder / _INDEX, index, {})
        self._incoming.rmdir()
        return index

    def _variables(self, keys: Iterable[int]) -> np.ndarray:
        """Numbers (N,) of variables while the map is written, ascending."""
        numbers = []
        for key in set(keys):
            if gtsam.symbolChr(key) == _FRAME:
                numbers.append(gtsam.symbolIndex(key))
            else:
                numbers.append(self._numbers.setdefault(key, _BESIDE + len(self._numbers)))
        return np.array(sorted(numbers), np.int64)

    def _by_parts(
        self, chunk: _Chunk, cut: Partition, variables: "_Variables"
    ) -> list[tuple[int, _Chunk]]:
        """Landmarks and factors of a chunk, by the part that owns them."""
        sightings, graph = chunk.sightings, deserialized(chunk.graph)
        num = len(sightings.points_world)
        owners = cut.owners(sightings.frames.astype(np.int64), sightings.points, num)
        factors: dict[int, gtsam.NonlinearFactorGraph] = defaultdict(gtsam.NonlinearFactorGraph)
        for i, keys in enumerate(_keys_of_factors(graph)):
            rows = variables.rows(keys)
            owner = int(cut.owners(rows, np.zeros(len(rows), np.int64), 1)[0])
            factors[owner].push_back(graph.at(i))
        out = []
        for part in sorted({*np.unique(owners).tolist(), *factors}):
            mine = owners == part
            graph_of = serialized(factors.get(part, gtsam.NonlinearFactorGraph()))
            out.append((part, _Chunk(sightings.taken(mine), chunk.numbers[mine], graph_of)))
        return out

    def _write_part(
        self, number: int, num_chunks: int, cut: Partition, variables: "_Variables"
    ) -> tuple[np.ndarray, int]:
        """Merge the chunks of a part; its nodes (N,) int64, and the number of those on cuts."""
        folder = part_folder(self._folder, number)
        folder.mkdir(exist_ok=True)
        paths = [folder / f"chunk-{n:06d}.npz" for n in range(num_chunks)]
        chunks = [load(path, _Chunk) for path in paths]
        graph = gtsam.NonlinearFactorGraph()
        for chunk in chunks:
            graph.push_back(deserialized(chunk.graph))
        seen = [chunk.sightings.frames.astype(np.int64) for chunk in chunks]
        seen += [variables.rows(keys) for keys in _keys_of_factors(graph)]
        numbered = np.repeat(np.arange(len(self._ties)), 2)
        owners = cut.owners(self._ties.ravel(), numbered, len(self._ties))
        seen.append(self._ties[owners == number].ravel())
        touched = np.unique(np.concatenate([np.empty(0, np.int64), *seen]))
        shared = touched[cut.on_cut[touched]]
        own = np.flatnonzero((cut.homes == number) & ~cut.on_cut)
        if not np.isin(touched[~cut.on_cut[touched]], own).all():
            raise RuntimeError(f"part {number} owns factors of another part's frames")
        rows = np.concatenate([own, shared]).astype(np.int64)
        frames = rows[rows < variables.num_frames].astype(np.int32)
        local = np.empty(variables.num_frames, np.int32)
        local[frames] = np.arange(len(frames), dtype=np.int32)
        numbers = np.concatenate([np.empty(0, np.int64), *(chunk.numbers for chunk in chunks)])
        sightings = merged([chunk.sightings for chunk in chunks], local)
        keys, num_kept = variables.keys_of(rows), len(variables.nodes_of(shared))
        part = MapPart(frames, keys, num_kept, sightings, numbers, serialized(graph))
        save_record(folder / "given.npz", part, {})
        for path in paths:
            path.unlink()
        return variables.nodes_of(rows), num_kept


class _Variables:
    """Rows, keys and nodes of the variables of a map: frames first."""

    def __init__(self, num_frames: int, keys: Sequence[int], dims: Sequence[int]) -> None:
        self.num_frames = num_frames
        self._keys = keys
        self._row = {key: num_frames + n for n, key in enumerate(keys)}
        counts = [1] * num_frames + [-(-dim // _BLOCK) for dim in dims]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def rows(self, keys: Iterable[int]) -> np.ndarray:
        """Rows (N,) of keys, ascending."""
        beside, frame = self._row, _FRAME
        rows = [
            gtsam.symbolIndex(key) if gtsam.symbolChr(key) == frame else beside[key]
            for key in set(keys)
        ]
        return np.array(sorted(rows), np.int64)

    def keys_of(self, rows: np.ndarray) -> np.ndarray:
        """Keys (N,) int64 of rows."""
        num = self.num_frames
        keys = [X(row) if row < num else self._keys[row - num] for row in rows.tolist()]
        return np.array(keys, np.int64)

    def nodes_of(self, rows: np.ndarray) -> np.ndarray:
        """Nodes of rows, one row's after the other's."""
        counts = self._first[rows + 1] - self._first[rows]
        places = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.repeat(self._first[rows], counts) + places


def deserialized(graph: np.ndarray) -> gtsam.NonlinearFactorGraph:
    """Factors of a part."""
    out = gtsam.NonlinearFactorGraph()
    if len(graph):
        out.deserialize(graph.tobytes().decode("latin-1"))
    return out


def serialized(graph: gtsam.NonlinearFactorGraph) -> np.ndarray:
    """Factors as bytes; NotStorableError if one is written in Python."""
    if not graph.size():
        return np.empty(0, np.uint8)
    try:
        return np.frombuffer(graph.serialize().encode("latin-1"), np.uint8)
    except RuntimeError as error:
        raise NotStorableError(
            "a factor that is written in Python cannot be stored with the parts of a map: use "
            "GTSAM's own factors"
        ) from error


def _keys_of_factors(graph: gtsam.NonlinearFactorGraph) -> list[list[int]]:
    return [graph.at(i).keys() for i in range(graph.size())]


def _covisible(sightings: ObservedRows) -> np.ndarray:
    """Codes (P,) of frame pairs with a common landmark."""
    seen_by, points = sightings.frames, sightings.points
    if not len(seen_by):
        return np.empty(0, np.int64)
    frames, local = np.unique(seen_by, return_inverse=True)
    ones = np.ones(len(local), np.float32)
    shape = len(frames), len(sightings.points_world)
    seen = csr_array((ones, (local, points)), shape=shape)
    shared = (seen @ seen.T).tocoo()
    upper = shared.row < shared.col
    wide = frames.astype(np.int64)
    return wide[shared.row[upper]] << 32 | wide[shared.col[upper]]


def _places(positions: np.ndarray, pairs: np.ndarray, num: int) -> np.ndarray:
    """Positions (N, 3) of frames (F, 3), and of other variables amid the frames tied to them."""
    num_frames = len(positions)
    sums, counts = np.zeros((num, 3)), np.zeros(num)
    for one, other in (pairs.T, pairs.T[::-1]):
        tied = (one >= num_frames) & (other < num_frames)
        np.add.at(sums, one[tied], positions[other[tied]])
        np.add.at(counts, one[tied], 1.0)
    places = sums / np.maximum(counts, 1.0)[:, None]
    places[:num_frames] = positions
    return places


def values_at(frames: Iterable[int], poses: np.ndarray) -> gtsam.Values:
    """Variables X(frame) of frames (N,) at pose rows (N, 12)."""
    values = gtsam.Values()
    for frame, row in zip(frames, poses, strict=True):
        rotation = gtsam.Rot3(row[:9].reshape(3, 3))
        values.insert(X(int(frame)), gtsam.Pose3(rotation, row[9:]))
    return values
