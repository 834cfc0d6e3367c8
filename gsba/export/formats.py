"""Export of a reconstruction in every format."""

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.config import FORMATS_OF
from gsba.export.dataset import FITTING, Dataset, ExportFormat, ExportOptions
from gsba.export.exposures import write_exposures
from gsba.export.folder import output_folder
from gsba.export.images import has_masks, write_pictures
from gsba.export.pictures import FrameWriter
from gsba.export.split import require_held_out
from gsba.log import GsbaError, brief
from gsba.placement.placement import Placement
from gsba.similarity import Sim3
from gsba.store.finished import cameras_of_map, map_digest, one_map
from gsba.store.shards import Workers, content_digest
from gsba.store.store import fingerprint
from gsba.types import FrameSet, PoseStatus, Reconstruction
from gsba.version import __version__

logger = logging.getLogger(__name__)


def export(
    reconstruction: Reconstruction,
    frames: FrameSet,
    out: Path | str,
    to: ExportFormat,
    face_size: int | None = None,
    placement: Placement | None = None,
    workers: Workers | None = None,
    **choices: Any,
) -> None:
    """Write one map of a reconstruction in another program's format.

    An interrupted export resumes when it is called again with the same arguments.

    Args:
        reconstruction: poses and cloud; only nerfstudio's format rotates their world, by its
            `applied_transform`.
        frames: the frames it was made from, still on disk.
        out: folder to write; an earlier export there is replaced, other folders are refused.
        face_size: pixels of a cube face; None = see `gsba.export.images.face_size_for`.
        placement: placement of the exported world, which `transform.json` states; None = the run's
            world.
        workers: workers that write images; None = threads of this process.
        choices: other fields of `ExportOptions`, e.g. `lenses` or `map_number`.

    Raises:
        GsbaError: `out` is in use or not seen by a worker, the format does not fit the frames,
            there is no such map, two images would have one name, too few panoramas are left beside
            those to hold out, or the disk cannot be written; nothing is left behind then.
    """
    options = ExportOptions(face_size, placement, **choices)
    export_all(reconstruction, frames, {to: Path(out)}, options, workers)


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
    digest = map_digest(reconstruction, frames)
    # Frames (F',) int64 of a map that an export holds.
    for name in options.without:
        if name not in frames.names:
            raise GsbaError(f"there is no frame {brief(name)} in the map to leave out")
    rows = np.arange(len(frames)) if options.fetched else frames.chosen()
    kept = [row for row in rows.tolist() if frames.names[row] not in options.without]
    if not kept:
        raise GsbaError("no frame is left to export: leave out fewer")
    rows = np.array(kept, np.int64)
    if len(rows) < len(frames):
        reconstruction, frames = reconstruction.taken(rows), frames.taken(rows)
        cameras = cameras.taken(rows)
    if options.split:
        require_held_out(reconstruction)
    if options.masks.paints and not has_masks(frames) and options.images != "fisheye":
        logger.warning("no frame has a mask: images are not painted")
    unrefined = np.flatnonzero(reconstruction.pose_statuses == PoseStatus.UNREFINED)
    if len(unrefined):
        names = ", ".join(frames.names[f] for f in unrefined[:5])
        more = ", ... (all in poses.csv)" if len(unrefined) > 5 else ""
        logger.warning("%d exported frames have unrefined poses: %s%s", len(unrefined), names, more)
    if len(reconstruction.points_world) == 0:
        logger.warning("the export holds poses but no points, and splat trainers need points")
    own = Placement(map_number=map_number).of_trajectory(reconstruction.origin)
    placement = replace(options.placement or own, map_digest=digest)
    unplaced, reconstruction = reconstruction, placement.apply(reconstruction)
    seen_by, up = cameras.scaled(placement.similarity.scale), placement.up
    files = (path for paths in (*frames.paths, frames.mask_paths) for path in paths)
    read = fingerprint(path for path in files if path and path.exists())  # some formats read none
    key = __version__, reconstruction, frames, read, up, seen_by, options
    datasets: list[Path] = []
    writers: list[list[FrameWriter]] = []
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
) -> list[list[FrameWriter]]:
    """Write a dataset of an unplaced map with its placement; returns the writers of images."""
    from gsba.export import colmap, gltf, metashape, nerfstudio, opensfm, panoramas, photos, ply

    if to == ExportFormat.OPENSFM:
        turn = Sim3(rotation=nerfstudio.z_up_R_world(placement.up))
        placement = replace(
            placement,
            similarity=turn.after(placement.similarity),
            up=placement.up and "z",
            offset=turn.rotation @ placement.offset,
        )
    placement.write(partial / "transform.json")
    images = options.images
    if (to, images) == (ExportFormat.METASHAPE, "auto") and all(
        k.panoramic for k in frames.formats
    ):
        images = "panorama"
    placed = placement.apply(unplaced)
    data = Dataset(partial, placed, frames, cameras, to, images, placement, options)
    match to:
        case ExportFormat.COLMAP | ExportFormat.COLMAP_FLAT:
            writers = [colmap.write_colmap(data)]
        case ExportFormat.COLMAP_ERP:
            writers = [colmap.write_colmap_erp(data)]
        case ExportFormat.NERFSTUDIO:
            writers = nerfstudio.write_nerfstudio(data)
        case ExportFormat.OPENSFM:
            writers = [opensfm.write_opensfm(data)]
        case ExportFormat.METASHAPE:
            writers = [metashape.write_metashape(data)]
        case ExportFormat.GLTF:
            writers = gltf.write_blender(data)
        case ExportFormat.PLY:
            writers = []
            ply.write_cloud(partial / "points3D.ply", placed)
        case ExportFormat.TUM:
            writers = panoramas.write_poses(data)
    if options.photos.photos:
        photos.add_photos(data)
    return writers


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
    if options.split and to not in (ExportFormat.COLMAP_FLAT, ExportFormat.NERFSTUDIO):
        raise GsbaError(
            f"--split holds panoramas out in colmap-flat and nerfstudio, not in {to.value}"
        )
    if options.shutter.exposure_s is not None and to != ExportFormat.NERFSTUDIO:
        raise GsbaError(f"--exposure-ms goes with nerfstudio, 3dgs-deblur, not with {to.value}")
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
