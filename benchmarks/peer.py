"""The peer of `benchmarks/pipeline.py`: COLMAP's panorama reconstruction of a folder of frames.

    python benchmarks/peer.py spherical-incremental FRAMES OUT [--matcher exhaustive]

Writes the peer's models and T_world_panorama of their posed frames: `trajectory.tum` of the largest
model, `trajectory1.tum` and so on of smaller ones. Times of frames are their numbers in name order.
The perspective modes need Pillow.
"""

import argparse
import sys
from pathlib import Path

MODES = (
    "spherical-incremental",
    "spherical-global",
    "perspective-incremental",
    "perspective-global",
)


def reconstruct(mode: str, frames: Path, out: Path, matcher: str) -> None:
    """Run one mode with the peer's defaults on the CPU, and write its models' poses.

    Raises:
        SystemExit: the peer found no model.
    """
    import pycolmap
    from pycolmap import panorama

    from gsba.trajectory.files import write_tum

    render, mapper = mode.split("-")
    spherical = render == "spherical"
    kind = panorama.PanoRenderType
    options = panorama.PanoramaReconstructionOptions(
        mapper=panorama.Mapper(mapper),
        matcher=panorama.Matcher(matcher),
        render_type=kind.SPHERICAL if spherical else kind.PERSPECTIVE_OVERLAPPING,
        random_seed=0,
        use_gpu=False,
        show_progress=False,
    )
    out.mkdir(parents=True, exist_ok=True)
    models = panorama.reconstruct(frames, out, options)
    if not models:
        sys.exit("the peer found no model")
    largest_first = sorted(models, key=lambda index: -models[index].num_reg_frames())
    for n, index in enumerate(largest_first):
        model = models[index]
        if not spherical:  # the peer's own conversion of its rig of views
            model = pycolmap.Reconstruction(out / "sparse_equirectangular" / str(index))
        write_tum(out / f"trajectory{n or ''}.tum", _trajectory(model, frames))


def _trajectory(model, frames: Path):
    """Poses of the model's panoramas, by the frames' numbers in name order."""
    import numpy as np

    from gsba.types import Trajectory

    number = {path.name: i for i, path in enumerate(sorted(frames.iterdir()))}
    posed = [image for image in model.images.values() if image.has_pose]
    posed.sort(key=lambda image: number[image.name])
    world_T_panos = np.tile(np.eye(4), (len(posed), 1, 1))
    for world_T_pano, image in zip(world_T_panos, posed, strict=True):
        world_T_pano[:3] = image.cam_from_world().inverse().matrix()
    times = np.array([number[image.name] for image in posed], dtype=np.float64)
    return Trajectory(times, world_T_panos)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("mode", choices=MODES)
    parser.add_argument("frames", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--matcher", choices=("sequential", "exhaustive"), default="sequential")
    arguments = parser.parse_args()
    reconstruct(arguments.mode, arguments.frames, arguments.out, arguments.matcher)
