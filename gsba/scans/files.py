"""Reading of scans: clouds and meshes by open3d (imported here alone), LAS and LAZ by laspy."""

import logging
import struct
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from gsba.frames.times import read_lines
from gsba.geometry import local_origin
from gsba.log import GsbaError, brief
from gsba.scans.trial import limited, try_in_process
from gsba.scans.types import NEIGHBOURS, POINTS_AT_ONCE, Scan

logger = logging.getLogger(__name__)

CLOUDS, MESHES, LASER = (".pcd",), (".obj", ".glb", ".gltf"), (".las", ".laz")
SUFFIXES = (".ply", *CLOUDS, *LASER, *MESHES)
_MAX_POINTS = 400_000  # of a thinned scan
_MAX_COORDINATE = 1e9  # in a scan's file
_MIN_POINTS = 1000
_MIN_PAIRS = 3
_NUM_MESH_SAMPLES = 1_000_000  # points sampled on a mesh, before it is thinned
_VLR_BYTES, _EVLR_BYTES = 54, 60  # of the header of a variable-length record


def check_claims(path: Path) -> None:
    """Refuse LAS, LAZ and PCD files that claim more points than their size allows."""
    suffix, size = path.suffix.lower(), path.stat().st_size
    with path.open("rb") as file:
        head = file.read(1 << 16)
    try:
        if suffix in (".las", ".laz"):
            # LAS 1.4, section 2.4; LAZ sets high bits of the format
            if head[:4] != b"LASF":
                raise ValueError
            head_size, first, num_records, kind, length, num = struct.unpack_from(
                "<HIIBHI", head, 94
            )
            num_late = late = 0
            if head[25] >= 4:
                late, num_late, more = struct.unpack_from("<QIQ", head, 235)
                num = max(num, more)
            # of LAS 1.0 to 1.2
            if head_size < 227 or not length:
                raise ValueError
            if head_size + _VLR_BYTES * num_records > size or late + _EVLR_BYTES * num_late > size:
                raise _TooMuch(f"{num_records} and {num_late} variable-length records")
            each = 0.2 if kind & 0xC0 else length  # equal points in a row take 0.3 bytes each
            if num and first + each * num > size:
                raise _TooMuch(f"{num} points")
        elif suffix == ".pcd":
            _check_pcd(head, size)
    except _TooMuch as claim:
        raise GsbaError(
            f"{path} claims {claim}, more than its {size} bytes can hold: it is truncated or "
            "damaged; copy or export it again"
        ) from None
    except (struct.error, ValueError, IndexError, KeyError):
        raise GsbaError(
            f"{path}: cannot be read (its header is damaged): copy or export it again"
        ) from None


class _TooMuch(Exception):
    """A header claims more than the file can hold; the message is the claim."""


def _check_pcd(head: bytes, size: int) -> None:
    """Check the header of a PCD file: lines of a word and numbers, of which DATA is the last."""
    fields: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in fields:
        end = head.index(b"\n", at)
        word, *numbers = head[at:end].decode("ascii", "replace").split() or ["#"]
        fields[word] = numbers
        at = end + 1
    names, kinds = fields["FIELDS"], fields["TYPE"]
    sizes = [int(text) for text in fields["SIZE"]]
    counts = [int(text) for text in fields.get("COUNT", ["1"] * len(names))]
    width, height = (int(fields.get(word, ["1"])[0]) for word in ("WIDTH", "HEIGHT"))
    num = int(fields["POINTS"][0]) if "POINTS" in fields else width * height
    if not len(names) == len(sizes) == len(counts) == len(kinds):
        raise ValueError
    if min([*sizes, *counts, num, width, height], default=0) < 0 or set(sizes) - {1, 2, 4, 8}:
        raise ValueError
    length = sum(a * b for a, b in zip(sizes, counts, strict=True))
    form, left = fields["DATA"][0], size - at
    if form == "ascii":
        least = 2 * sum(counts) * num  # a digit and a separator
        room = left + 1
    elif form == "binary":
        least, room = length * num, left
    else:
        packed, unpacked = struct.unpack_from("<II", head, at)
        # of uncompressed to compressed bytes
        least, room = max(length * num, unpacked), 255 * min(packed, left - 8)
        if packed > left - 8:
            raise _TooMuch(f"{packed} bytes of points")
    if least > room or width * height < num:
        raise _TooMuch(f"{num} points")


def open3d() -> ModuleType:
    """Import open3d; GsbaError with the install command if it or a system library is missing."""
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
    """Picked point pairs, one a line: texts that name points of the run (a frame, or x,y,z), and
    points (N, 3) of the scan's file (X,Y,Z). GsbaError for a line like no other, or less than
    three."""
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
    """Check the suffix and access of a scan's file, and the libraries that read it."""
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
    """Surfaces of a scan, some 400,000 points with normals: meshes sampled evenly, clouds thinned
    to the mean point of each cell, on the plane through its neighbours. GsbaError if it is missing,
    damaged, of an unknown format, or too small."""
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
    """Triangles of a mesh file with colours or textures, as open3d's TriangleMesh; GsbaError if
    none."""
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
    if suffix in LASER:
        points, colors = _of_laser(path)
    else:
        cloud = open3d().io.read_point_cloud(str(path))
        points, colors = np.array(cloud.points), np.array(cloud.colors)
        colors = colors if cloud.has_colors() else None
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


def on_planes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) projected to their neighbours' planes, unit normals (N, 3), and scatters (N,).

    Independent noise shrinks with the square root of the number of neighbours. Without the
    projection, alignment would keep all of it and prefer points whose noise happens to fit. Near
    edges, where neighbours share no plane, points are not moved, and their scatter is the standard
    deviation of their neighbours about the plane; elsewhere it is 0.
    """
    tree = KDTree(points)
    neighbours = min(NEIGHBOURS, len(points))
    normals, offsets, scatters = [], [], []
    for start in range(0, len(points), POINTS_AT_ONCE):
        some = points[start : start + POINTS_AT_ONCE]
        around = points[tree.query(some, neighbours)[1]]
        middles = around.mean(axis=1)
        around = around - middles[:, None]
        values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / neighbours)
        normals.append(axes[:, :, 0])
        offsets.append(np.einsum("ni,ni->n", axes[:, :, 0], middles - some))
        scatters.append(np.sqrt(np.maximum(values[:, 0], 0)))
    across, off, scatter = (np.concatenate(parts) for parts in (normals, offsets, scatters))
    # a tenth of the points at least are on planes: their scatter is noise
    flat = scatter <= 3.5 * np.quantile(scatter, 0.1)
    laid = points + np.where(flat, off, 0)[:, None] * across
    return laid, across, np.where(flat, 0, scatter)
