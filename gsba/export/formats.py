"""One door to every export format."""

import logging
from enum import StrEnum
from pathlib import Path

import numpy as np

from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.export.folder import output_folder
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.types import FrameSet, PoseStatus, Reconstruction, Trajectory

logger = logging.getLogger(__name__)


class ExportFormat(StrEnum):
    """What `export` can write; see the module of each for its layout and conventions."""

    COLMAP = "colmap"  # rig of pinhole faces
    COLMAP_FLAT = "colmap-flat"  # the same with unique base names, for splat trainers
    COLMAP_ERP = "colmap-erp"  # one equirectangular camera
    NERFSTUDIO = "nerfstudio"  # transforms.json: pinhole faces, and panoramas
    PLY = "ply"  # points3D.ply, the start cloud of splat trainers
    TUM = "tum"  # trajectory.tum


def export(
    reconstruction: Reconstruction,
    frames: FrameSet,
    out: Path,
    to: ExportFormat,
    face_size: int | None = None,
    placement: Placement | None = None,
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
    raw: bool = False,
) -> None:
    """Write a reconstruction in another program's format, all frames of it.

    Args:
        reconstruction: poses and cloud; nerfstudio's format alone turns its world, as the
            `applied_transform` there states.
        frames: the frames it was made from, still on disk.
        out: folder to write; an earlier export there is replaced, anything else refused.
        to: the format.
        face_size: pixels of a cube face; None = see `gsba.export.images.face_size_for`.
        placement: where to put the world; None = where the run has it. `transform.json` states it.
        link: hard links to the frames where these leave unchanged, not copies: who edits one edits
            the other.
        lenses: of the frames, in the unit of the reconstruction: faces are of one lens each then.

        raw: raw fisheyes go out as they are, not as faces; only in COLMAP's formats.

    Raises:
        GsbaError: `out` is in use, the format does not fit the frames, or the disk refuses;
            nothing is left behind then.
    """
    unrefined = np.flatnonzero(reconstruction.pose_statuses == PoseStatus.UNREFINED)
    if len(unrefined):
        names = ", ".join(frames.names[f] for f in unrefined[:5])
        more = ", ..." if len(unrefined) > 5 else ""
        logger.warning("%d frames go out with unrefined poses: %s%s", len(unrefined), names, more)
    if len(reconstruction.points_world) == 0:
        logger.warning("no points: the poses alone go out, and trainers need a start cloud")
    placement = placement or Placement()
    reconstruction = placement.apply(reconstruction)
    with output_folder(out, to.value) as partial:
        seen_by = lenses.scaled(placement.similarity.scale)
        if raw:
            _write_raw(partial, reconstruction, frames, to, link, seen_by)
        else:
            z_up = placement.up == "z"
            _write(partial, reconstruction, frames, to, face_size, z_up, link, seen_by)
        placement.write(partial / "transform.json")
    logger.info(
        "%s: %d frames, %d points, in %s", to, len(frames), len(reconstruction.points_world), out
    )


def _write_raw(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    link: bool,
    lenses: Lenses,
) -> None:
    from gsba.export import colmap

    if to not in (ExportFormat.COLMAP, ExportFormat.COLMAP_FLAT):
        raise GsbaError(f"--images fisheye goes with colmap or colmap-flat, not with {to.value}")
    flat = to == ExportFormat.COLMAP_FLAT
    colmap.write_colmap_raw(partial, reconstruction, frames, lenses, flat, link)


def _write(
    partial: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    to: ExportFormat,
    face_size: int | None,
    z_up: bool,
    link: bool,
    lenses: Lenses,
) -> None:
    from gsba.export import colmap, nerfstudio, ply

    match to:
        case ExportFormat.COLMAP:
            colmap.write_colmap(partial, reconstruction, frames, face_size, link, lenses)
        case ExportFormat.COLMAP_FLAT:
            colmap.write_colmap_flat(partial, reconstruction, frames, face_size, link, lenses)
        case ExportFormat.COLMAP_ERP:
            colmap.write_colmap_erp(partial, reconstruction, frames, link)
        case ExportFormat.NERFSTUDIO:
            nerfstudio.write_nerfstudio(
                partial, reconstruction, frames, face_size, z_up, link, lenses
            )
        case ExportFormat.PLY:
            ply.write_splat_points(
                partial / "points3D.ply", reconstruction.points_world, reconstruction.point_colors
            )
        case ExportFormat.TUM:
            from gsba.trajectory.files import write_tum

            trajectory = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
            write_tum(partial / "trajectory.tum", trajectory)
