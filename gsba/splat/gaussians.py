"""The Gaussians of a splat, and their initialisation from a cloud."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from gsba.disk import read_vertices, write_vertices
from gsba.log import GsbaError

SH_CONSTANT = 0.28209479177387814  # value of the harmonic of degree 0


@dataclass(frozen=True, slots=True)
class Gaussians:
    """Parameters of N Gaussians as they are optimised and stored, one row each.

    The colour seen along a unit direction is max(0, 0.5 + sum of harmonics times coefficients).
    """

    means: np.ndarray  # (N, 3) float32, world, map units
    log_scales: np.ndarray  # (N, 3) float32, natural logarithm of the standard deviations
    quaternions: np.ndarray  # (N, 4) float32, wxyz, any length: world from the Gaussian's axes
    opacity_logits: np.ndarray  # (N,) float32
    sh: np.ndarray  # (N, K, 3) float32, RGB coefficients of the K = (degree + 1)^2 harmonics

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest degree with coefficients."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def usable_degree(self, wanted: int | None) -> int:
        """The degree to render with, at most the wanted one; None = the highest."""
        return self.sh_degree if wanted is None else min(wanted, self.sh_degree)

    def arrays(self) -> tuple[np.ndarray, ...]:
        """The five parameter arrays, in the order of the fields."""
        return tuple(getattr(self, entry.name) for entry in fields(self))

    def select(self, rows: np.ndarray) -> "Gaussians":
        """Copies of some rows: indices or a mask."""
        return Gaussians(*(array[rows] for array in self.arrays()))

    def is_finite(self) -> bool:
        """True if every parameter is a number."""
        return all(bool(np.isfinite(array).all()) for array in self.arrays())


def num_parameters(sh_degree: int) -> int:
    """Number of parameters of a Gaussian."""
    return 3 + 3 + 4 + 1 + 3 * (sh_degree + 1) ** 2


def concatenate(parts: "list[Gaussians]") -> Gaussians:
    """Several sets of Gaussians as one."""
    columns = zip(*(part.arrays() for part in parts), strict=True)
    return Gaussians(*(np.concatenate(column) for column in columns))


def zeros_like(gaussians: Gaussians) -> Gaussians:
    """Gaussians with all parameters zero, to accumulate gradients."""
    return Gaussians(*(np.zeros_like(array) for array in gaussians.arrays()))


def from_cloud(
    points_world: np.ndarray,
    colors: np.ndarray,
    sh_degree: int = 3,
    opacity: float = 0.1,
) -> Gaussians:
    """Round Gaussians at the points (N, 3) of a cloud, map units, with RGB colours (N, 3) uint8, as
    wide as the distance to their neighbours; harmonics but the constant one start at zero.

    The start of Kerbl et al., 3D Gaussian Splatting, 2023: the standard deviation is the root mean
    square distance to the three nearest points, limited to a tenth of the cloud's extent. Raises
    GsbaError: the cloud has no points, or points that are not finite.
    """
    points = np.asarray(points_world, np.float64)
    if len(points) == 0:
        raise GsbaError("the cloud has no points to start a splat from: refine the run first")
    if not np.isfinite(points).all():
        raise GsbaError("the cloud has points that are not finite: refine the run again")
    from scipy.spatial import cKDTree  # type: ignore[attr-defined]

    spread = np.linalg.norm(points.std(axis=0))
    if len(points) > 1:
        distances, _ = cKDTree(points).query(points, k=min(3, len(points) - 1) + 1)
        widths = np.sqrt(np.mean(np.square(distances[:, 1:]), axis=1))
        widths = np.clip(widths, 1e-4 * spread + 1e-9, max(0.1 * spread, 1e-8))
    else:
        widths = np.ones(1)
    sh = np.zeros((len(points), (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (np.asarray(colors, np.float64) / 255 - 0.5) / SH_CONSTANT
    return Gaussians(
        points.astype(np.float32),
        np.repeat(np.log(widths)[:, None], 3, axis=1).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1)),
        np.full(len(points), np.log(opacity / (1 - opacity)), np.float32),
        sh,
    )


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write a splat in the layout of INRIA's 3D Gaussian Splatting, atomically by renaming.

    Properties, all float32: `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`.
    f_rest holds all coefficients of red, then green, then blue; opacity is a logit, scales are
    logarithms, the rotation is wxyz. GsbaError: the file cannot be written.
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
    """Read a splat of degree 0 to 3, its properties by name: other writers leave out or reorder
    some. GsbaError: the file is unreadable, no PLY of a splat, truncated, or holds values that are
    not finite."""
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
