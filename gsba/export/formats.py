"""Export of a reconstruction in every format."""

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.config import FORMATS_OF
from gsba.export.exposures import write_exposures
from gsba.export.folder import output_folder
from gsba.export.images import has_masks, write_pictures
from gsba.export.masks import MASK_FILES, MaskStyle
from gsba.export.motion import UNKNOWN, Shutter
from gsba.export.photos import FITTING, Photos, add_photos
from gsba.export.pictures import FrameWriter
from gsba.export.split import require_held_out
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.store.finished import cameras_of_map, one_map
from gsba.store.shards import Workers, content_digest
from gsba.store.store import fingerprint
from gsba.types import FrameSet, PoseStatus, Reconstruction
from gsba.version import __version__

logger = logging.getLogger(__name__)

NO_PHOTOS = Photos()


class ExportFormat(StrEnum):
    """Formats of `export`; the module of each documents its layout and conventions."""

    COLMAP = "colmap"  # rig of pinhole faces
    COLMAP_FLAT = "colmap-flat"  # pinhole faces with unique base names, for splat trainers
    COLMAP_ERP = "colmap-erp"  # one equirectangular camera
    NERFSTUDIO = "nerfstudio"  # transforms.json: pinhole faces, and panoramas
    OPENSFM = "opensfm"  # reconstruction.json, tracks.csv: panoramas
    METASHAPE = "metashape"  # cameras.xml: panoramas, or pinhole faces
    GLTF = "gltf"  # scene.glb: cameras and cloud, and panoramas on request
    PLY = "ply"  # points3D.ply, the start cloud of splat trainers
    TUM = "tum"  # trajectory.tum, and panoramas on request


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Choices of an export, see `export`."""

    face_size: int | None = None  # pixels of a cube face; None = by the frames
    placement: Placement | None = None  # of the exported world; None = the run's world
    link: bool = False  # hard links to unchanged frames
    lenses: Lenses | Cameras = ONE_CENTRE  # of the frames, in the unit of the reconstruction: of
    # all frames, or of each camera's
    images: str = "auto"  # the setting `export.images`
    map_number: int = 1  # 1 = the largest map
    fetched: bool = False  # with the frames that were added where the map was weak
    shutter: Shutter = UNKNOWN  # for trainers that model blur and rolling rows
    photos: Photos = NO_PHOTOS  # localised photos, as cameras of their own
    split: bool | None = None  # hold panoramas out of the training, in formats of trainers; None =
    # if enough are left to train on
    masks: MaskStyle = MASK_FILES
    cameras: tuple[str, ...] = ()  # COLMAP's camera models that the reader knows; () = all
    panoramas: bool = True  # also panoramas beside faces, in nerfstudio's format
    depths: bool = False  # with the depths of points in the images
    exposures: bool = False  # with the exposures of the frames


def export(
    reconstruction: Reconstruction,
    frames: FrameSet,
    out: Path,
    to: ExportFormat,
    face_size: int | None = None,
    placement: Placement | None = None,
    link: bool = False,
    lenses: Lenses | Cameras = ONE_CENTRE,
    images: str = "auto",
    workers: Workers | None = None,
    map_number: int = 1,
    fetched: bool = False,
    shutter: Shutter = UNKNOWN,
    photos: Photos = NO_PHOTOS,
    split: bool | None = None,
    masks: MaskStyle = MASK_FILES,
    depths: bool = False,
    exposures: bool = False,
) -> None:
    """Write one map of a reconstruction in another program's format.

    An interrupted export resumes when it is called again with the same arguments.

    Args:
        reconstruction: poses and cloud; only nerfstudio's format rotates their world, by its
            `applied_transform`.
        frames: the frames it was made from, still on disk.
        out: folder to write; an earlier export there is replaced, other folders are refused.
        to: the format.
        face_size: pixels of a cube face; None = see `gsba.export.images.face_size_for`.
        placement: placement of the exported world, which `transform.json` states; None = the run's
            world.
        link: make hard links to frames that are exported unchanged, not copies: an edit of one is
            an edit of the other.
        lenses: lenses of the frames, or cameras of which each has its own, in the unit of the
            reconstruction: each face is of one lens then, and panoramas are stitched at the map's
            depth.
        images: the setting `export.images`: fisheye for raw fisheyes, panorama for panoramas alone,
            else faces.
        workers: workers that write images; None = threads of this process.
        map_number: number of the map, 1 = the largest.
        fetched: also write the frames that were added where the map was weak (see `FrameSet`).
        shutter: times of the exposure, which nerfstudio's format states.
        photos: localised photos, as cameras of their own beside the faces.
        split: hold panoramas out of the training (colmap-flat, nerfstudio); False = all are for
            training; None = if at least two panoramas are left to train on.
        masks: how masks are written, and whether images are painted where they hide.
        depths: also write the depths of points in pinhole faces, see `gsba.export.depths`.
        exposures: also estimate the exposures of frames, see `gsba.export.exposures`.

    Raises:
        GsbaError: `out` is in use or not seen by a worker, the format does not fit the frames,
            there is no such map, two images would have one name, too few panoramas are left beside
            those to hold out, or the disk cannot be written; nothing is left behind then.
    """
    given = face_size, placement, link, lenses, images, map_number, fetched, shutter
    options = ExportOptions(*given, photos, split, masks, depths=depths, exposures=exposures)
    export_all(reconstruction, frames, {to: out}, options, workers)


def export_all(
    reconstruction: Reconstruction,
    frames: FrameSet,
    outs: Mapping[ExportFormat, Path],
    options: ExportOptions | None = None,
    workers: Workers | None = None,
) -> None:
    """Write one map in several formats; every image is read, cut and encoded once.

    Args:
        reconstruction, frames: see `export`.
        outs: folder of each format.
        options: choices that hold for all formats.
        workers: see `export`.

    Raises:
        GsbaError: see `export`; none of the folders is written then.
    """
    options = options or ExportOptions()
    map_number = options.map_number
    for to in outs:
        _require_fitting(to, frames, options)
    whole = reconstruction
    cameras = Cameras.of(options.lenses, frames)
    reconstruction, frames = one_map(whole, frames, map_number, "the reconstruction")
    cameras = cameras_of_map(cameras, whole, map_number)
    if not options.fetched and any(frames.fetched):
        rows = frames.chosen()
        reconstruction, frames = reconstruction.taken(rows), frames.taken(rows)
        cameras = cameras.taken(rows)
    if options.split:
        require_held_out(reconstruction)
    _warn_of_gaps(reconstruction, frames, options)
    own = Placement(map_number=map_number).of_trajectory(reconstruction.origin)
    placement = options.placement or own
    unplaced, reconstruction = reconstruction, placement.apply(reconstruction)
    seen_by, up = cameras.scaled(placement.similarity.scale), placement.up
    files = (path for paths in (*frames.paths, frames.mask_paths) for path in paths)
    read = fingerprint(path for path in files if path and path.exists())  # some formats read none
    key = __version__, reconstruction, frames, read, up, seen_by, options
    datasets: list[Path] = []
    writers: list[FrameWriter] = []
    with ExitStack() as folders:
        for to, out in outs.items():
            folder = output_folder(out, to.value, content_digest(to.value, *key))
            partial = folders.enter_context(folder)
            datasets.append(partial)
            writers += _write_dataset(partial, unplaced, frames, to, placement, seen_by, options)
        write_pictures(frames, writers, workers)
        for partial in datasets if options.exposures else ():
            write_exposures(partial)
    for to, out in outs.items():
        num_points = len(reconstruction.points_world)
        logger.info("%s: %d frames, %d points, in %s", to, len(frames), num_points, out)


def _write_dataset(
    partial: Path,
    unplaced: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    placement: Placement,
    cameras: Cameras,
    options: ExportOptions,
) -> list[FrameWriter]:
    """Write a dataset of an unplaced map with its placement; returns the writers of images."""
    from gsba.export import opensfm

    if to == ExportFormat.OPENSFM:
        placement = opensfm.z_up(placement)
    reconstruction, up, link = placement.apply(unplaced), placement.up, options.link
    given = partial, reconstruction, frames
    placement.write(partial / "transform.json")
    shown_as = _images_of(to, options.images, frames)
    if to == ExportFormat.OPENSFM:
        return [opensfm.write_opensfm(*given, placement, link, cameras, options.masks)]
    if shown_as == "fisheye":
        return _write_raw(*given, to, up, link, cameras, options)
    if shown_as == "panorama":
        return _write_panoramas(*given, to, up, link, cameras, options)
    writers = _write(*given, to, up, link, cameras, options)
    if options.photos.photos:
        undistort = bool(options.cameras) and "RADIAL" not in options.cameras
        masked = has_masks(frames) and not options.masks.path
        add_photos(partial, to.value, options.photos, placement, undistort, masked)
    return writers


def _images_of(to: ExportFormat, images: str, frames: FrameSet) -> str:
    """Setting `export.images` of a format: what `auto` gives differs."""
    if (
        to == ExportFormat.METASHAPE
        and images == "auto"
        and all(kind.panoramic for kind in frames.formats)
    ):
        return "panorama"
    return images


def _warn_of_gaps(reconstruction: Reconstruction, frames: FrameSet, options: ExportOptions) -> None:
    """Warn of unrefined poses, of a missing point cloud, and of masks to paint that are missing."""
    if options.masks.paints and not has_masks(frames) and options.images != "fisheye":
        logger.warning("no frame has a mask: images are not painted")
    unrefined = np.flatnonzero(reconstruction.pose_statuses == PoseStatus.UNREFINED)
    if len(unrefined):
        names = ", ".join(frames.names[f] for f in unrefined[:5])
        more = ", ... (all in poses.csv)" if len(unrefined) > 5 else ""
        logger.warning("%d exported frames have unrefined poses: %s%s", len(unrefined), names, more)
    if len(reconstruction.points_world) == 0:
        logger.warning("the export holds poses but no points, and splat trainers need points")


def _write_raw(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    up: str | None,
    link: bool,
    cameras: Cameras,
    options: ExportOptions,
) -> list[FrameWriter]:
    from gsba.export import colmap, nerfstudio

    given, last = (partial, reconstruction, frames, cameras), (_splits(options), options.masks)
    if to == ExportFormat.NERFSTUDIO:
        return nerfstudio.write_nerfstudio_raw(*given, up, link, options.shutter, *last)
    return [colmap.write_colmap_raw(*given, to == ExportFormat.COLMAP_FLAT, link, *last)]


def _splits(options: ExportOptions) -> bool:
    return options.split is not False


def _write_panoramas(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    up: str | None,
    link: bool,
    cameras: Cameras,
    options: ExportOptions,
) -> list[FrameWriter]:
    from gsba.export import colmap, gltf, metashape, nerfstudio, panoramas

    given, masks = (partial, reconstruction, frames), options.masks
    match to:
        case ExportFormat.METASHAPE:
            return [metashape.write_metashape_panoramas(*given, link, cameras, masks)]
        case ExportFormat.COLMAP_ERP:
            return [colmap.write_colmap_erp(*given, link, cameras, masks)]
        case ExportFormat.NERFSTUDIO:
            last = _splits(options), masks
            return nerfstudio.write_nerfstudio_erp(*given, cameras, up, link, *last)
        case ExportFormat.GLTF:
            return gltf.write_blender(*given, up, link, cameras, panoramas=True)
        case _:
            return [panoramas.write_with_poses(*given, cameras, link, masks)]


def _require_fitting(to: ExportFormat, frames: FrameSet, options: ExportOptions) -> None:
    """Refuse images that the format cannot hold or its reader cannot read."""
    images, photos = options.images, options.photos
    fitting = FORMATS_OF.get(images, (to.value,))
    if to.value not in fitting:
        choices = ", ".join(fitting)
        raise GsbaError(f"--images {images} goes with {choices}, not with {to.value}")
    with_faces = to.value in FITTING and images not in ("fisheye", "panorama")
    if options.depths and not with_faces:
        raise GsbaError(
            f"depths are those of cube faces in {', '.join(FITTING)}, not of {to.value} with "
            f"--images {images}"
        )
    if options.exposures and to not in (ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT):
        raise GsbaError(f"exposures go with colmap and colmap-flat, not with {to.value}")
    if photos.photos and not with_faces:
        raise GsbaError(
            f"photos go beside cube faces in {', '.join(FITTING)}, not in {to.value} with "
            f"--images {images}"
        )
    if images == "fisheye" and options.cameras and "OPENCV_FISHEYE" not in options.cameras:
        known = ", ".join(options.cameras)
        raise GsbaError(
            f"--images fisheye: the program reads cameras {known} alone: use --images lenses"
        )
    if images == "panorama" and not all(kind.panoramic for kind in frames.formats):
        raise GsbaError("--images panorama needs panoramas, these frames are cube faces: use cube")


def _write(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    up: str | None,
    link: bool,
    cameras: Cameras,
    options: ExportOptions,
) -> list[FrameWriter]:
    from gsba.export import colmap, gltf, metashape, nerfstudio, ply
    from gsba.export.panoramas import write_poses

    given, face_size = (partial, reconstruction, frames), options.face_size
    split, masks, num_photos = _splits(options), options.masks, len(options.photos.photos)
    match to:
        case ExportFormat.COLMAP:
            given = *given, face_size, link, cameras, masks
            return [colmap.write_colmap(*given, depths=options.depths)]
        case ExportFormat.COLMAP_FLAT:
            given = *given, face_size, link, cameras, split, masks, num_photos
            return [colmap.write_colmap_flat(*given, depths=options.depths)]
        case ExportFormat.COLMAP_ERP:
            return [colmap.write_colmap_erp(*given, link, cameras, masks)]
        case ExportFormat.NERFSTUDIO:
            given = *given, face_size, up, link, cameras
            last = options.shutter, split, masks, options.panoramas, options.depths
            return nerfstudio.write_nerfstudio(*given, *last)
        case ExportFormat.METASHAPE:
            return [metashape.write_metashape_faces(*given, face_size, link, cameras, masks)]
        case ExportFormat.GLTF:
            gltf.write_blender(*given, up)
        case ExportFormat.PLY:
            ply.write_splat_points(
                partial / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
            )
        case ExportFormat.TUM:
            write_poses(partial, reconstruction, frames)
    return []
