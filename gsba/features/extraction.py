"""Features of every frame of a run, stored frame by frame."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsba.camera.rig import CubeRig
from gsba.config import CubemapSettings, RefineSettings
from gsba.features import detection
from gsba.features.detection import Extractor
from gsba.frames import cubemap
from gsba.memory import freed_memory_kept
from gsba.store.shards import StoredRecords
from gsba.store.store import PerFrame, RunStore, fingerprint
from gsba.types import Features, FrameSet


@dataclass(frozen=True, slots=True)
class FrameFeatures:
    """Features of frames by index, read from their store."""

    found: Sequence[PerFrame[Features]]  # (F,) the extraction that holds each frame
    names: tuple[str, ...]  # (F,)

    def __call__(self, frame: int) -> Features:
        return self.found[frame][self.names[frame]]

    def taken(self, frames: Iterable[int]) -> Callable[[int], Features]:
        """The features of some frames, with paths for other processes."""
        paths: dict[int, Path] = {}
        keys: dict[int, str] = {}
        for frame in frames:
            stored = self.found[frame].records({frame: self.names[frame]})
            paths |= stored.paths
            keys |= stored.keys
        return StoredRecords(paths, keys, Features)


@dataclass(frozen=True, slots=True)
class _Extraction:
    """The job of extracting a frame's features; image and mask are read, cut and released."""

    frames: FrameSet
    index: Mapping[str, int]
    rig: CubeRig  # faces that pixels are given on
    settings: CubemapSettings
    make_extractor: Callable[[], Extractor]
    known: Mapping[str, Features] = field(default_factory=dict)  # of frames searched before

    def __call__(self, name: str) -> Features:
        if name in self.known:
            return self.known[name]
        frame = self.index[name]
        own = cubemap.rig_for(self.frames.format_of(frame), self.settings)
        images, masks = cubemap.load(self.frames, frame, own)
        found = detection.extract(images, masks, own, self.make_extractor())
        if own == self.rig:
            return found
        return replace(found, pixels=self.rig.project(found.bearings_rig, found.faces))

    def taken(self, names: Sequence[str]) -> "_Extraction":
        frames = self.frames.taken(np.array([self.index[name] for name in names]), absolute=True)
        known = {name: self.known[name] for name in names if name in self.known}
        index = {name: f for f, name in enumerate(names)}
        return replace(self, frames=frames, index=index, known=known)


@dataclass(frozen=True, slots=True)
class Search:
    """Frames, and how they are searched for keypoints."""

    frames: FrameSet  # each camera's are searched on faces of their own
    rig: CubeRig  # faces that pixels are given on
    settings: RefineSettings
    make_extractor: Callable[[], Extractor]  # makes an extractor, once for each frame

    def of(self, rows: Sequence[int]) -> dict[str, Features]:
        """Features of some frames (F',) by name, which are not stored."""
        names = [self.frames.names[f] for f in rows]
        compute = self.job(dict(zip(names, rows, strict=True)))
        with freed_memory_kept(), ThreadPoolExecutor(self.settings.solver.threads()) as pool:
            return dict(zip(names, pool.map(compute, names), strict=True))

    def job(
        self, index: Mapping[str, int], known: Mapping[str, Features] | None = None
    ) -> _Extraction:
        """The job of extracting the features of frames by name, some of which are known."""
        cut = self.settings.cubemap
        return _Extraction(self.frames, index, self.rig, cut, self.make_extractor, known or {})


def extract(
    store: RunStore,
    search: Search,
    files: Sequence[Path],
    name: str = "features",
    chosen_frames: np.ndarray | None = None,
    known: Mapping[str, Features] | None = None,
) -> PerFrame[Features]:
    """Features by frame name, of frames chosen by (F,) bool, None = all; image and mask are read,
    cut and released one at a time. Those that the same search found before are known by name;
    files: that the extractor depends on, weights of a learned one."""
    frames, rig, settings = search.frames, search.rig, search.settings
    index = {
        frame: f
        for f, frame in enumerate(frames.names)
        if chosen_frames is None or chosen_frames[f]
    }
    chosen = settings.features

    compute = search.job(index, known)
    inputs = {
        frame: (
            fingerprint([*frames.paths[f], frames.mask_paths[f]]),
            frames.format_of(f).fisheyes,  # of its own camera, by which it is cut
        )
        for frame, f in index.items()
    }
    relevant = chosen.model_dump(exclude={"weights", "accept_noncommercial", "download"})
    key = [settings.cubemap, relevant, fingerprint(files), rig]
    with freed_memory_kept():
        return store.per_frame(name, key, inputs, compute, Features)


def adopted(
    store: RunStore,
    frames: FrameSet,
    rig: CubeRig,
    settings: CubemapSettings,
    make_extractor: Callable[[], Extractor],
    stored: Sequence[Path],
) -> PerFrame[Features]:
    """Features that other runs have stored, a file (F,) for each frame, by frame name; extracted
    again where a file is gone."""
    index = {frame: f for f, frame in enumerate(frames.names)}
    compute = _Extraction(frames, index, rig, settings, make_extractor)
    return store.adopt("features", dict(zip(frames.names, stored, strict=True)), compute, Features)
