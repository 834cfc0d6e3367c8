"""Features of every frame of a run, stored frame by frame."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from gsba.camera.rig import CubeRig
from gsba.config import RefineSettings
from gsba.features import detection
from gsba.features.detection import Extractor
from gsba.frames import cubemap
from gsba.store.store import PerFrame, RunStore, fingerprint
from gsba.types import Features, FrameSet


def extract(
    store: RunStore,
    frames: FrameSet,
    rig: CubeRig,
    settings: RefineSettings,
    num_threads: int,
    make_extractor: Callable[[], Extractor],
    files: Sequence[Path],
    name: str = "features",
    chosen_frames: np.ndarray | None = None,
) -> PerFrame[Features]:
    """Features by frame name; image and mask are read, cut and released one at a time.

    Args:
        store, frames, rig, settings: of the run.
        num_threads: frames treated at a time.
        make_extractor: makes what finds keypoints, for each frame.
        files: that it depends on: weights of a learned one.
        name: of the stage.
        chosen_frames: (F,) bool, frames treated; None = all.
    """
    detection.keep_freed_memory()
    index = {
        frame: f
        for f, frame in enumerate(frames.names)
        if chosen_frames is None or chosen_frames[f]
    }
    chosen = settings.features

    def compute(frame: str) -> Features:
        images, masks = cubemap.load(frames, index[frame], rig)
        return detection.extract(images, masks, rig, make_extractor())

    inputs = {
        frame: fingerprint([*frames.paths[f], frames.mask_paths[f]]) for frame, f in index.items()
    }
    relevant = chosen.model_dump(exclude={"weights", "accept_noncommercial", "download"})
    cut = [] if frames.fisheyes is None else [list(map(asdict, frames.fisheyes))]
    key = [settings.cubemap, relevant, fingerprint(files), *cut]
    return store.per_frame(name, key, inputs, compute, Features, num_threads=num_threads)
