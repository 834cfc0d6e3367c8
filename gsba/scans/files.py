"""Scans from their files: clouds and meshes by open3d, LAS and LAZ by laspy; normals and features.

The one module that imports open3d.
"""

import logging
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gsba.frames.times import read_lines
from gsba.log import GsbaError, brief
from gsba.scans.claims import check_claims
from gsba.scans.surfaces import on_planes
from gsba.scans.trial import limited, try_in_process
from gsba.scans.types import Scan

logger = logging.getLogger(__name__)

CLOUDS, MESHES, LASER = (".pcd",), (".obj", ".glb", ".gltf"), (".las", ".laz")
SUFFIXES = (".ply", *CLOUDS, *LASER, *MESHES)
_MOST_POINTS = 400_000  # of a thinned scan
_SAMPLES = 1_000_000  # on a mesh, before it is thinned
_FURTHEST = 1e9  # units from the origin of a file that a scan may be
_FAR = 1e4  # coordinates beyond lose digits as float32: an offset is kept apart
_MIN_POINTS = 1000
_MIN_PAIRS = 3


def open3d() -> ModuleType:
    """The library, if it is there and its system libraries are.

    Raises:
        GsbaError: with what to install.
    """
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise GsbaError(
            f"scans need open3d ({error.name} is missing): pip install 'gsba[scan]'"
        ) from None
    except (ImportError, OSError) as error:
        raise GsbaError(
            f"open3d cannot be loaded ({error}): apt-get install libx11-6 libgl1 libegl1 "
            "libgomp1 libusb-1.0-0, or what your system calls them"
        ) from None
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def upwards(path: Path) -> str:
    """Which axis of a scan's world points up: y of OBJ and glTF, z of all others."""
    return "y" if path.suffix.lower() in MESHES else "z"


def read_pairs(path: Path) -> tuple[list[str], np.ndarray]:
    """Picked pairs: what names a point of the run, and points (N, 3) of the scan's file.

    Lines of two columns: a frame, or x,y,z in the run's world; X,Y,Z of the scan.

    Raises:
        GsbaError: with the line that cannot be used, or there are fewer than three.
    """
    ends, points = [], []
    for number, line in read_lines(path):
        try:
            end, text = line.rsplit(maxsplit=1)
            point = [float(part) for part in text.split(",")]
        except ValueError:
            point = []
        if len(point) != 3 or not np.isfinite(point).all():
            raise GsbaError(
                f"{path}:{number}: {brief(line)}: want a frame or x,y,z, and then X,Y,Z of the scan"
            )
        ends.append(end)
        points.append(point)
    if len(ends) < _MIN_PAIRS:
        raise GsbaError(f"{path}: holds {len(ends)} pairs; {_MIN_PAIRS} are needed")
    return ends, np.array(points)


def check_scan(path: Path) -> None:
    """Raise GsbaError where a scan cannot be one: by its name, or what reads it is missing."""
    if path.suffix.lower() not in SUFFIXES:
        raise GsbaError(f"{path}: is no scan: give one of {', '.join(SUFFIXES)}")
    if path.exists() and not path.is_file():
        raise GsbaError(f"{path}: cannot be read (it is no file)")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    open3d()
    if path.suffix.lower() in LASER:
        _laspy()


def read_scan(path: Path) -> Scan:
    """A scan's surfaces, thinned to some 400,000 points with normals.

    Meshes are sampled evenly over their surfaces. Of clouds, each point left is the mean of a cell,
    laid on the plane through its neighbours, see `gsba.scans.surfaces`.

    Raises:
        GsbaError: no such file, none that is understood, or too little in it.
    """
    check_scan(path)
    try_in_process(path)
    o3d, (mesh, points, colors) = open3d(), _content(path)
    if mesh is not None:
        vertices = np.asarray(mesh.vertices)
        offset = _offset(vertices)
        mesh.vertices = o3d.utility.Vector3dVector(vertices - offset)
        o3d.utility.random.seed(0)
        cloud = mesh.sample_points_uniformly(_SAMPLES, use_triangle_normal=True)
    else:
        offset = _offset(points)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - offset))
        if colors is not None:
            cloud.colors = o3d.utility.Vector3dVector(colors)
    cloud = _thinned(cloud, path)
    scatters = None
    if mesh is None:
        points, normals, scatters = on_planes(np.asarray(cloud.points))
    else:
        points, normals = np.array(cloud.points), np.array(cloud.normals)
    lengths = np.linalg.norm(normals, axis=1)
    good = np.isfinite(lengths) & (lengths > 0.1)
    if good.sum() < _MIN_POINTS:
        raise GsbaError(f"{path}: has {good.sum()} points on surfaces; a scan has {_MIN_POINTS}")
    light = np.array(cloud.colors).mean(axis=1)[good] if cloud.has_colors() else None
    if light is not None and np.ptp(light) == 0:
        light = None
    if scatters is not None:
        scatters = scatters[good]
    scan = Scan(points[good], normals[good] / lengths[good, None], offset, light, scatters)
    logger.info("%s: %d points, %.3g apart", path, len(points), scan.spacing)
    return scan


def read_mesh(path: Path) -> Any:
    """Triangles of a mesh file with what colours them, as open3d's TriangleMesh.

    Raises:
        GsbaError: it cannot be read, or holds no triangles.
    """
    try_in_process(path)
    mesh = _mesh(path)
    if mesh is None:
        raise GsbaError(f"{path}: holds no triangles that open3d can read")
    return mesh


def read_on_trial(path: str) -> None:
    """Read a scan or mesh in this process, which ends with that; see `gsba.scans.trial`."""
    open3d()
    limited(Path(path), _content)


def _content(path: Path) -> tuple[Any, np.ndarray, np.ndarray | None]:
    """The mesh of a file, or None; points and colours (M, 3) of a cloud, or None.

    Raises:
        GsbaError: it cannot be read, or holds neither.
    """
    suffix = path.suffix.lower()
    mesh = _mesh(path) if suffix in MESHES or suffix == ".ply" else None
    if mesh is not None:
        return mesh, np.zeros((0, 3)), None
    if suffix in MESHES:
        raise GsbaError(f"{path}: holds no triangles that open3d can read")
    check_claims(path)
    points, colors = (_of_laser if suffix in LASER else _of_cloud)(path)
    good = (np.abs(points) < _FURTHEST).all(axis=1)
    return None, points[good], None if colors is None else colors[good]


def _mesh(path: Path) -> Any:
    """A file's triangles; None where there are none.

    Raises:
        GsbaError: they have corners that are not there, or at no place.
    """
    mesh = open3d().io.read_triangle_mesh(str(path), enable_post_processing=True)
    triangles, vertices = np.asarray(mesh.triangles), np.asarray(mesh.vertices)
    if not len(triangles):
        return None
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise GsbaError(f"{path}: has triangles whose corners are not there; export it again")
    if not (np.abs(vertices) < _FURTHEST).all():
        raise GsbaError(f"{path}: has corners that are no numbers or beyond {_FURTHEST:g} units")
    if not mesh.get_surface_area() > 0:
        raise GsbaError(f"{path}: its triangles have no surface")
    return mesh


def normals_of(points: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of the planes through the neighbours of points (N, 3)."""
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    return np.array(cloud.normals)


def _of_cloud(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and colours (M, 3) of a PLY or PCD file."""
    cloud = open3d().io.read_point_cloud(str(path))
    return np.array(cloud.points), np.array(cloud.colors) if cloud.has_colors() else None


def _laspy() -> ModuleType:
    try:
        import laspy  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise GsbaError("LAS and LAZ need laspy: pip install 'gsba[scan]'") from None
    return laspy


def _of_laser(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points and colours (M, 3), or intensities in place of these, of a LAS or LAZ file."""
    laspy = _laspy()
    try:
        file = laspy.read(path)
        names = set(file.point_format.dimension_names)
        with np.errstate(all="ignore"):  # what is no number then is left out
            points = np.array(file.xyz, np.float64)
        seen = ("red", "green", "blue") if {"red", "green", "blue"} <= names else ("intensity",) * 3
        colors = np.stack([np.asarray(file[name], np.float64) for name in seen], axis=1)
    except Exception as error:  # of the parser, each in its own words
        why = " ".join(str(error).split()) or "damaged, or cut short"
        raise GsbaError(f"{path}: cannot be read ({why})") from None
    return points, colors / max(colors.max(initial=0), 1.0)


def _offset(points: np.ndarray) -> np.ndarray:
    """What is kept apart of large coordinates (3,)."""
    if not len(points):
        return np.zeros(3)
    middle = np.median(points, axis=0)
    return np.round(middle, -2) if np.abs(middle).max() > _FAR else np.zeros(3)


def _thinned(cloud: Any, path: Path) -> Any:
    """At most so many points, one for each cell that has some, and no two at one place.

    Raises:
        GsbaError: too few are left.
    """
    points = np.asarray(cloud.points)
    cell = float(np.ptp(points, axis=0).max()) / 1000 if len(points) else 0.0
    while cell and len(cloud.points) > _MOST_POINTS:
        cloud, cell = cloud.voxel_down_sample(cell), cell * 1.3
    cloud = cloud.remove_duplicated_points()
    num = len(cloud.points)
    if num < _MIN_POINTS:
        raise GsbaError(f"{path}: holds {num} points at different places; a scan has {_MIN_POINTS}")
    return cloud
