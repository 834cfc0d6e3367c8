"""Features of every frame of a run, stored frame by frame."""

from functools import partial

from gsba import cubemap, features
from gsba.config import RefineSettings
from gsba.rig import CubeRig
from gsba.store import PerFrame, RunStore, fingerprint
from gsba.types import Features, FrameSet


def run(
    store: RunStore, frames: FrameSet, rig: CubeRig, settings: RefineSettings, num_threads: int
) -> PerFrame[Features]:
    """Features by frame name; image and mask are read, cut and released one at a time."""
    features.keep_freed_memory()
    index = {name: f for f, name in enumerate(frames.names)}
    chosen, weights = settings.features, None
    if chosen.extractor == "sift":
        make_extractor = partial(features.SiftExtractor, chosen)
    else:
        from gsba.learned import LearnedExtractor, find_weights

        found = find_weights(settings)  # of the matcher too: before the work, not after
        make_extractor = partial(LearnedExtractor, chosen, found["features"])
        weights = fingerprint([found["features"]])

    def compute(name: str) -> Features:
        images, masks = cubemap.load(frames, index[name], rig)
        return features.extract(images, masks, rig, make_extractor())

    inputs = {
        name: fingerprint([*frames.paths[f], frames.mask_paths[f]]) for name, f in index.items()
    }
    relevant = chosen.model_dump(exclude={"weights", "accept_noncommercial", "download"})
    key = [settings.cubemap, relevant, weights]
    return store.per_frame("features", key, inputs, compute, Features, num_threads=num_threads)
