"""Features of every frame of a run, stored frame by frame."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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

    def __call__(self, name: str) -> Features:
        frame = self.index[name]
        own = cubemap.rig_for(self.frames.format_of(frame), self.settings)
        images, masks = cubemap.load(self.frames, frame, own)
        found = detection.extract(images, masks, own, self.make_extractor())
        if own == self.rig:
            return found
        return replace(found, pixels=self.rig.project(found.bearings_rig, found.faces))

    def taken(self, names: Sequence[str]) -> "_Extraction":
        frames = self.frames.taken(np.array([self.index[name] for name in names]), absolute=True)
        return replace(self, frames=frames, index={name: f for f, name in enumerate(names)})


def extract(
    store: RunStore,
    frames: FrameSet,
    rig: CubeRig,
    settings: RefineSettings,
    make_extractor: Callable[[], Extractor],
    files: Sequence[Path],
    name: str = "features",
    chosen_frames: np.ndarray | None = None,
) -> PerFrame[Features]:
    """Features by frame name; image and mask are read, cut and released one at a time.

    Args:
        store, frames, rig, settings: those of the run; each camera's frames are searched on faces
            of their own, and pixels given on the faces of the rig.
        make_extractor: makes an extractor, once for each frame.
        files: that the extractor depends on: weights of a learned one.
        name: name of the stage.
        chosen_frames: (F,) bool, frames to extract; None = all.
    """
    index = {
        frame: f
        for f, frame in enumerate(frames.names)
        if chosen_frames is None or chosen_frames[f]
    }
    chosen = settings.features

    compute = _Extraction(frames, index, rig, settings.cubemap, make_extractor)
    inputs = {
        frame: fingerprint([*frames.paths[f], frames.mask_paths[f]]) for frame, f in index.items()
    }
    relevant = chosen.model_dump(exclude={"weights", "accept_noncommercial", "download"})
    cut = [[list(map(asdict, kind.fisheyes or ())) for kind in frames.formats], rig]
    key = [settings.cubemap, relevant, fingerprint(files), *cut]
    with freed_memory_kept():
        return store.per_frame(name, key, inputs, compute, Features)


def adopted(
    store: RunStore,
    frames: FrameSet,
    rig: CubeRig,
    settings: CubemapSettings,
    make_extractor: Callable[[], Extractor],
    stored: Sequence[Path],
    name: str = "features",
) -> PerFrame[Features]:
    """Features that other runs have stored, by frame name; extracted again where a file is gone.

    Args:
        store, frames, rig, settings: those of the run.
        make_extractor: makes an extractor, once for each frame.
        stored: (F,) file of each frame in the folder of another run.
        name: name of the stage.
    """
    index = {frame: f for f, frame in enumerate(frames.names)}
    compute = _Extraction(frames, index, rig, settings, make_extractor)
    return store.adopt(name, dict(zip(frames.names, stored, strict=True)), compute, Features)
