"""`point_cloud.ply` in the layout of INRIA's 3D Gaussian Splatting, which every viewer opens.

Properties, all float32: `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`.
f_rest holds all coefficients of red, then green, then blue; opacity is a logit, scales are
logarithms, the rotation is wxyz. Other writers leave out the normals or reorder: properties are
read by name.
"""

from pathlib import Path

import numpy as np

from gsba.disk import read_vertices, write_vertices
from gsba.log import GsbaError
from gsba.splat.gaussians import Gaussians


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a splat, atomically by renaming.

    Raises:
        GsbaError: the file cannot be written.
    """
    num = len(gaussians)
    names = _names(gaussians.sh.shape[1])
    rest = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(num, -1)
    columns = [gaussians.means, np.zeros((num, 3)), gaussians.sh[:, 0], rest]
    columns += [gaussians.opacity_logits[:, None], gaussians.log_scales]
    columns += [gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1)[:, None]]
    rows = np.concatenate(columns, axis=1).astype("<f4")
    vertices = rows.view([(name, rows.dtype) for name in names])[:, 0]
    write_vertices(path, vertices)


def read_ply(path: Path) -> Gaussians:
    """Read a splat of degree 0 to 3.

    Raises:
        GsbaError: the file is unreadable, no PLY of a splat, truncated, or holds values that are
            not finite.
    """
    rows = read_vertices(path)
    num, names = len(rows), rows.dtype.names or ()
    num_rest = sum(name.startswith("f_rest_") for name in names)
    if num_rest not in (0, 9, 24, 45):
        raise GsbaError(f"{path}: {num_rest} f_rest properties; a splat has 0, 9, 24 or 45")
    missing = [n for n in _names(num_rest // 3 + 1) if n not in names and n not in _NORMALS]
    if missing:
        raise GsbaError(f"{path}: not a Gaussian splat: it has no property {missing[0]!r}")

    def gather(prefix: str, count: int) -> np.ndarray:
        columns = [rows[f"{prefix}{i}"] for i in range(count)]
        return np.stack(columns, axis=1).astype(np.float32) if count else np.empty((num, 0))

    rest = gather("f_rest_", num_rest).reshape(num, 3, -1).transpose(0, 2, 1)
    sh = np.concatenate([gather("f_dc_", 3)[:, None], rest], axis=1).astype(np.float32)
    means = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32)
    opacities = rows["opacity"].astype(np.float32)
    found = Gaussians(means, gather("scale_", 3), gather("rot_", 4), opacities, sh)
    if not found.is_finite() or not found.quaternions.any(axis=1).all():
        raise GsbaError(f"{path}: holds values that are not finite, or rotations of length zero")
    return found


_NORMALS = ("nx", "ny", "nz")


def _names(num_harmonics: int) -> list[str]:
    """Property names in INRIA's order."""
    names = ["x", "y", "z", *_NORMALS, *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * (num_harmonics - 1))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    return names
