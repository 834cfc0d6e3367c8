"""Records of frames and maps, plain where a test says nothing of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba.types import FrameSet, PictureFormat, PoseStatus, Reconstruction


def frames_of(
    form: PictureFormat,
    paths: Sequence[tuple[Path, ...]],
    times: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    mask: Path | None = None,
) -> FrameSet:
    """Frames of one camera by their files, a second apart, named by their numbers; one mask."""
    num = len(paths)
    times = np.arange(float(num)) if times is None else times
    names = tuple(map(str, range(num)) if names is None else names)
    return FrameSet(names, tuple(paths), times, (mask,) * num, (form,))


def map_of(
    world_T_rigs: np.ndarray,
    points: np.ndarray,
    owners: np.ndarray,
    frames: np.ndarray,
    bearings: np.ndarray,
    sigma: float = 1e-3,
    **more: object,
) -> Reconstruction:
    """Refined poses (F, 4, 4), of unknown covariances, and black points (J, 3) without error.

    Args:
        owners, frames, bearings: point (O,), frame (O,) and bearing (O, 3) of each observation.
        sigma: of bearings, radians.
        more: other fields.
    """
    num, observations = len(world_T_rigs), (owners.astype(np.int32), frames.astype(np.int32))
    made = Reconstruction(
        world_T_rigs,
        np.full((num, 6, 6), np.nan),
        np.full(num, PoseStatus.REFINED, np.uint8),
        points,
        np.zeros((len(points), 3), np.uint8),
        np.zeros(len(points)),
        *observations,
        bearings,
        np.full(len(bearings), sigma),
    )
    return replace(made, **more)  # type: ignore[arg-type]


def observing(whole: Reconstruction, rows: np.ndarray, **changes: object) -> Reconstruction:
    """A reconstruction with some of its observations, rows (N,) int or bool, and other changes."""
    names = [f"observation_{name}" for name in ("points", "frames", "bearings", "sigmas")]
    return replace(whole, **{name: getattr(whole, name)[rows] for name in names} | changes)
