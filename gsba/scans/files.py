"""Reading of scans: clouds and meshes by open3d, LAS and LAZ by laspy; normals of clouds.

Only this module imports open3d.
"""

import logging
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gsba.frames.times import read_lines
from gsba.geometry import local_origin
from gsba.log import GsbaError, brief
from gsba.scans.claims import check_claims
from gsba.scans.surfaces import on_planes
from gsba.scans.trial import limited, try_in_process
from gsba.scans.types import Scan

logger = logging.getLogger(__name__)

CLOUDS, MESHES, LASER = (".pcd",), (".obj", ".glb", ".gltf"), (".las", ".laz")
SUFFIXES = (".ply", *CLOUDS, *LASER, *MESHES)
_MAX_POINTS = 400_000  # of a thinned scan
_NUM_MESH_SAMPLES = 1_000_000  # points sampled on a mesh, before it is thinned
_MAX_COORDINATE = 1e9  # in a scan's file
_MIN_POINTS = 1000
_MIN_PAIRS = 3


def open3d() -> ModuleType:
    """Import open3d.

    Raises:
        GsbaError: open3d or a system library is missing; the message has the install command.
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
            "libgomp1 libusb-1.0-0, or the same libraries of your system"
        ) from None
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def upwards(path: Path) -> str:
    """Up axis of a scan's world: y for OBJ and glTF, z for all other formats."""
    return "y" if path.suffix.lower() in MESHES else "z"


def read_pairs(path: Path) -> tuple[list[str], np.ndarray]:
    """Picked point pairs: texts that name points of the run, and points (N, 3) of the scan's file.

    Lines have two columns: a frame, or x,y,z in the run's world; X,Y,Z of the scan.

    Raises:
        GsbaError: a line cannot be used, or there are fewer than three pairs.
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
                f"{path}:{number}: {brief(line)}: give a frame or x,y,z, and then X,Y,Z of the scan"
            )
        ends.append(end)
        points.append(point)
    if len(ends) < _MIN_PAIRS:
        raise GsbaError(f"{path} holds {len(ends)} pairs; {_MIN_PAIRS} are needed")
    return ends, np.array(points)


def check_scan(path: Path) -> None:
    """Check the suffix and access of a scan's file, and the libraries that read it.

    Raises:
        GsbaError: the suffix is unknown, the file cannot be read, or a library is missing.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise GsbaError(f"{path} is no scan: give a file of {', '.join(SUFFIXES)}")
    if path.exists() and not path.is_file():
        raise GsbaError(f"{path}: cannot be read (it is not a file)")
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    open3d()
    if path.suffix.lower() in LASER:
        _laspy()


def read_scan(path: Path) -> Scan:
    """Surfaces of a scan, thinned to some 400,000 points with normals.

    Meshes are sampled evenly over their surfaces. Clouds are thinned to the mean point of each
    cell, projected to the plane through its neighbours, see `gsba.scans.surfaces`.

    Raises:
        GsbaError: the file is missing, of an unknown format or damaged, or holds too few points.
    """
    check_scan(path)
    try_in_process(path)
    o3d, (mesh, points, colors) = open3d(), _content(path)
    if mesh is not None:
        vertices = np.asarray(mesh.vertices)
        offset = _origin_of(vertices)
        mesh.vertices = o3d.utility.Vector3dVector(vertices - offset)
        o3d.utility.random.seed(0)
        cloud = mesh.sample_points_uniformly(_NUM_MESH_SAMPLES, use_triangle_normal=True)
    else:
        offset = _origin_of(points)
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
        raise GsbaError(
            f"{path} has {good.sum()} points on surfaces; registration needs {_MIN_POINTS}"
        )
    light = np.array(cloud.colors).mean(axis=1)[good] if cloud.has_colors() else None
    if light is not None and np.ptp(light) == 0:
        light = None
    if scatters is not None:
        scatters = scatters[good]
    scan = Scan(points[good], normals[good] / lengths[good, None], offset, light, scatters)
    logger.info("%s: %d points, %.3g apart", path, len(points), scan.spacing)
    return scan


def read_mesh(path: Path) -> Any:
    """Triangles of a mesh file with colours or textures, as open3d's TriangleMesh.

    Raises:
        GsbaError: the file cannot be read, or holds no triangles.
    """
    try_in_process(path)
    mesh = _mesh(path)
    if mesh is None:
        raise GsbaError(f"{path} holds no triangles that open3d can read")
    return mesh


def read_on_trial(path: str) -> None:
    """Read a scan or mesh and end this process; see `gsba.scans.trial`."""
    open3d()
    limited(Path(path), _content)


def _content(path: Path) -> tuple[Any, np.ndarray, np.ndarray | None]:
    """Mesh of a file, or None; else the points (M, 3) of its cloud, and their colours or None."""
    suffix = path.suffix.lower()
    mesh = _mesh(path) if suffix in MESHES or suffix == ".ply" else None
    if mesh is not None:
        return mesh, np.zeros((0, 3)), None
    if suffix in MESHES:
        raise GsbaError(f"{path} holds no triangles that open3d can read")
    check_claims(path)
    points, colors = (_of_laser if suffix in LASER else _of_cloud)(path)
    good = (np.abs(points) < _MAX_COORDINATE).all(axis=1)
    return None, points[good], None if colors is None else colors[good]


def _mesh(path: Path) -> Any:
    """Triangles of a file; None if it has none."""
    mesh = open3d().io.read_triangle_mesh(str(path), enable_post_processing=True)
    triangles, vertices = np.asarray(mesh.triangles), np.asarray(mesh.vertices)
    if not len(triangles):
        return None
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise GsbaError(f"{path} has triangles whose corners are missing: export it again")
    if not (np.abs(vertices) < _MAX_COORDINATE).all():
        raise GsbaError(
            f"{path} has corners that are not finite or beyond {_MAX_COORDINATE:g} units: export "
            "it again"
        )
    if not mesh.get_surface_area() > 0:
        raise GsbaError(f"{path}: the area of its triangles is 0: export it again")
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
        with np.errstate(all="ignore"):  # points that are not finite are left out later
            points = np.array(file.xyz, np.float64)
        seen = ("red", "green", "blue") if {"red", "green", "blue"} <= names else ("intensity",) * 3
        colors = np.stack([np.asarray(file[name], np.float64) for name in seen], axis=1)
    except Exception as error:  # the parser raises errors of many types
        why = " ".join(str(error).split()) or "damaged or truncated"
        raise GsbaError(f"{path}: cannot be read ({why}): copy or export it again") from None
    return points, colors / max(colors.max(initial=0), 1.0)


def _origin_of(points: np.ndarray) -> np.ndarray:
    """Origin (3,) that is split off points far from 0, see `local_origin`; 0 for others."""
    origin = local_origin(points)
    return np.zeros(3) if origin is None else origin


def _thinned(cloud: Any, path: Path) -> Any:
    """Cloud of at most `_MAX_POINTS` points, one for each occupied cell, without duplicates."""
    points = np.asarray(cloud.points)
    cell = float(np.ptp(points, axis=0).max()) / 1000 if len(points) else 0.0
    while cell and len(cloud.points) > _MAX_POINTS:
        cloud, cell = cloud.voxel_down_sample(cell), cell * 1.3
    cloud = cloud.remove_duplicated_points()
    num = len(cloud.points)
    if num < _MIN_POINTS:
        raise GsbaError(f"{path} holds {num} distinct points; registration needs {_MIN_POINTS}")
    return cloud
