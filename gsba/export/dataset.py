"""Formats and options of an export, and the dataset that the module of a format writes."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.export.motion import UNKNOWN, Shutter
from gsba.placement.placement import Placement
from gsba.types import FrameSet, Reconstruction

Paint = Literal["files", "alpha", "black"]  # mask files alone; or images are painted, too


@dataclass(frozen=True, slots=True)
class MaskStyle:
    """Paths and values of a dataset's masks, and whether its images are painted by them."""

    paint: str = "files"  # one of Paint
    path: str = ""  # pattern of a mask's path, by `folder` and `stem` of its image; "" = by format
    hidden: int = 0  # value of pixels to ignore; those to use have 255 less this

    @property
    def paints(self) -> bool:
        """True if images are painted."""
        return self.paint != "files"

    def painted(self, image: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Image (h, w, 3) uint8, black where it is not used (h, w) bool; with `alpha` it has a
        fourth channel, 0 = ignore, 255 = use."""
        black = image * used[..., None]
        if self.paint == "black":
            return black
        return np.dstack([black, used.astype(np.uint8) * np.uint8(255)])

    def drawn(self, used: np.ndarray) -> np.ndarray:
        """Content (h, w) uint8 of a mask file for pixels to use (h, w) bool."""
        values = np.array([self.hidden, 255 - self.hidden], np.uint8)
        return values[used.astype(np.uint8)]


MASK_FILES = MaskStyle()  # mask files alone, as most readers want them
FITTING = ("colmap", "colmap-flat", "nerfstudio")  # formats of faces, that hold photos and depths


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
class PhotoCamera:
    """A camera that photos share: r = focal (t + k1 t^3 + k2 t^5), t = tan of the angle."""

    width: int  # pixels
    height: int  # pixels
    focal: float  # pixels
    principal: tuple[float, float]  # pixels, corner origin
    radial: tuple[float, float]  # k1, k2


@dataclass(frozen=True, slots=True)
class PlacedPhoto:
    """A photo with a pose in the run's world."""

    name: str
    path: Path
    world_T_camera: np.ndarray  # (4, 4) float64, x right, y down, z forward
    camera: int  # number of its camera


@dataclass(frozen=True, slots=True)
class Photos:
    """Photos of a run's place, and their cameras."""

    photos: tuple[PlacedPhoto, ...] = ()
    cameras: tuple[PhotoCamera, ...] = ()


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
    without: tuple[str, ...] = ()  # names of frames to leave out
    shutter: Shutter = UNKNOWN  # for trainers that model blur and rolling rows
    photos: Photos = Photos()  # localised photos, as cameras of their own
    split: bool | None = None  # hold panoramas out of the training, in formats of trainers; None =
    # if enough are left to train on
    masks: MaskStyle = MASK_FILES
    cameras: tuple[str, ...] = ()  # COLMAP's camera models that the reader knows; () = all
    panoramas: bool = True  # also panoramas beside faces, in nerfstudio's format
    depths: bool = False  # with the depths of points in the images
    exposures: bool = False  # with the exposures of the frames


@dataclass(frozen=True, slots=True)
class Dataset:
    """A dataset that is being written, of one map in the exported world."""

    folder: Path
    reconstruction: Reconstruction
    frames: FrameSet
    cameras: Cameras  # of the frames
    to: ExportFormat
    images: str  # the setting `export.images` of this format
    placement: Placement  # of the exported world
    options: ExportOptions

    @property
    def split(self) -> bool:
        """True to hold panoramas out of the training, if enough are left."""
        return self.options.split is not False
