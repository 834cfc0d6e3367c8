"""Point clouds as binary PLY: the run's own, and the start cloud of splat trainers."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gsba.disk import write_vertices
from gsba.types import Reconstruction


def write_points(path: Path, reconstruction: Reconstruction) -> None:
    """Write the cloud with residuals and track lengths, in the world of the trajectory.

    Properties: x y z (map units), red green blue, error_deg (mean angular residual, degrees),
    track_length (number of observations). Raises GsbaError: the disk cannot be written.
    """
    num_points = len(reconstruction.points_world)
    columns = {
        **_vectors("x y z", reconstruction.points_world, "<f4"),
        **_vectors("red green blue", reconstruction.point_colors, "u1"),
        "error_deg": np.degrees(reconstruction.point_errors).astype("<f4"),
        "track_length": np.bincount(reconstruction.observation_points, minlength=num_points).astype(
            "<i4"
        ),
    }
    _write(path, columns)


def write_splat_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write the start cloud of INRIA's 3D Gaussian Splatting and its descendants.

    Properties: x y z, nx ny nz (zero), red green blue.

    Args:
        points: (J, 3) float64, in the world of the exported cameras.
        colors: (J, 3) uint8, RGB.

    Raises:
        GsbaError: the disk cannot be written.
    """
    columns = {
        **_vectors("x y z", points, "<f4"),
        **_vectors("nx ny nz", np.zeros_like(points), "<f4"),
        **_vectors("red green blue", colors, "u1"),
    }
    _write(path, columns)


def write_cloud(path: Path, reconstruction: Reconstruction) -> None:
    """Write a map's points by `write_splat_points`."""
    write_splat_points(path, reconstruction.points_world, reconstruction.point_colors)


def _vectors(names: str, values: np.ndarray, dtype: str) -> dict[str, np.ndarray]:
    return {name: values[:, i].astype(dtype) for i, name in enumerate(names.split())}


def _write(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of one length as properties of points."""
    fields = [(name, column.dtype) for name, column in columns.items()]
    vertices = np.empty(len(next(iter(columns.values()))), fields)
    for name, column in columns.items():
        vertices[name] = column
    write_vertices(path, vertices)
