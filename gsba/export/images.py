"""Images and masks of an export, a few frames in memory at a time: faces are cut with bicubic
sampling, after a low pass if they are much coarser, as PNG of PNG or TIFF, else as JPEG; panoramas
and input faces of the exported size are exported unchanged where every trainer reads their format.
"""

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.one_centre import Stitcher
from gsba.camera.rig import CubeRig
from gsba.camera.views import Scenes, View, ViewCutter, scenes_of, views_for
from gsba.export.dataset import Dataset
from gsba.export.pictures import Files, FrameWriter, Pictures, SharedPixels
from gsba.frames.pixels import load_faces
from gsba.log import GsbaError
from gsba.memory import give_back_freed_memory
from gsba.store.shards import Threads, Workers
from gsba.types import FACES, FrameSet, PictureFormat

MIN_FACE_SIZE = 16  # pixels


def face_size_for(kind: PictureFormat, face_size: int | None) -> int:
    """Pixels of an exported face: `face_size`, or by default a quarter of the panorama's width.

    The default is rounded to an even number and keeps the mean resolution: a face centre is sampled
    1.27 times coarser than the panorama, an edge 1.57 times finer. Frames that are cube faces keep
    their size. Raises GsbaError: `face_size` is too small.
    """
    if face_size is None:
        return 2 * round(kind.width / 8) if kind.panoramic else kind.width
    if face_size < MIN_FACE_SIZE:
        raise GsbaError(f"face size {face_size} is too small: use {MIN_FACE_SIZE} pixels or more")
    return face_size


def of_one_lens(images: str, kind: PictureFormat) -> bool:
    """True if the setting `images` (`export.images`) gives images of one lens each."""
    return images in ("lenses", "fisheye", "panorama") or (
        images == "auto" and kind.fisheyes is not None and len(kind.fisheyes) == 2
    )


def seen_by(images: str, frames: FrameSet, cameras: Cameras) -> Cameras:
    """The cameras that images of a dataset are of: one centre each, or the lenses as they are;
    images: the setting `export.images`."""
    own = zip(frames.formats, cameras.lenses, strict=True)
    return cameras.with_lenses(
        [lenses if of_one_lens(images, kind) else ONE_CENTRE for kind, lenses in own]
    )


def has_masks(frames: FrameSet) -> bool:
    """True if any frame has a mask; then every exported image gets one."""
    return any(path is not None for path in frames.mask_paths)


def views_of_cameras(
    frames: FrameSet, face_size: int | None, cameras: Cameras
) -> list[tuple[View, ...]]:
    """Views (C) of the frames of each camera, faces of `face_size` pixels or by `face_size_for`."""
    return [
        views_for(kind, face_size_for(kind, face_size), lenses)
        for kind, lenses in zip(frames.formats, cameras.lenses, strict=True)
    ]


def view_writers(
    data: Dataset, files: Sequence[Files], views: Sequence[tuple[View, ...]]
) -> list[FrameWriter]:
    """Writers (C,) of every view of a camera's frames, and of masks if the frames have masks.

    Args:
        data: of panoramas, or of cube faces, of which missing ones are not written.
        files: (C,) files of the images of each camera's frames.
        views: (C,) of each camera, see `views_of_cameras`.
    """
    writers, scenes = list[FrameWriter](), scenes_of(data.reconstruction)
    given = zip(files, data.frames.formats, views, data.cameras.lenses, strict=True)
    for own, kind, seen, lenses in given:
        if lenses and kind.panoramic:
            writers.append(_LensFaces(own, lenses, scenes, seen))
        else:
            writers.append(_CubeFaces(own, seen[0].width, data.options.link))
    return writers


@dataclass(frozen=True, slots=True)
class _CubeFaces(FrameWriter):
    size: int  # pixels
    link: bool

    def __call__(self, shown: SharedPixels) -> None:
        import cv2

        from gsba.frames import cubemap

        f, frames, size = shown.f, shown.frames, self.size
        rig = CubeRig(size, np.pi / 2)
        as_it_is = not shown.kind.panoramic and size == shown.kind.width
        originals = frames.paths[f] if as_it_is else ()

        def cut() -> Iterable[np.ndarray]:
            if shown.kind.panoramic:
                (picture,) = shown.pictures(rig.focal, joined=True)
                room = shown.room("face", (size, size, 3))
                return cubemap.faces_of(picture, rig, out=room)
            how = cv2.INTER_AREA if size < shown.kind.width else cv2.INTER_CUBIC
            faces = load_faces(frames, f)
            return [cv2.resize(face, (size, size), interpolation=how) for face in faces]

        def cut_mask() -> np.ndarray:
            chosen = [FACES.index(face) for face in shown.kind.faces or FACES]
            if frames.mask_paths[f] is None:
                return np.ones((len(chosen), size, size), bool)
            return cubemap.cut_mask(shown.mask, rig)[chosen]

        self.write(shown, size, cut, cut_mask, originals=originals, link=self.link)


@dataclass(frozen=True, slots=True)
class _OfLenses(FrameWriter):
    lenses: Lenses
    scenes: Scenes

    def taken(self, rows: np.ndarray) -> FrameWriter:
        return replace(self, lenses=self.lenses.taken(rows), scenes=self.scenes.taken(rows))


@dataclass(frozen=True, slots=True)
class _LensFaces(_OfLenses):
    views: tuple[View, ...]

    def __call__(self, shown: SharedPixels) -> None:
        f, size = shown.f, self.views[0].width

        @cache
        def cutter() -> ViewCutter:
            return ViewCutter(self.views, self.lenses, f, self.scenes(f))

        def cut() -> Iterator[np.ndarray]:
            return cutter().cut(shown.pictures(cutter().focal))

        def cut_mask() -> Iterator[np.ndarray]:
            return iter(cutter().cut_mask(shown.mask))

        self.write(shown, ("of lenses", size), cut, cut_mask, masks_differ=True)


def write_pictures(
    frames: FrameSet, datasets: Sequence[Sequence[FrameWriter]], workers: Workers | None = None
) -> None:
    """Write the images of all datasets of an export, frame by frame.

    Args:
        datasets: writers (C,) of each dataset, whose folder exists, by camera.
        workers: workers that share the disk; None = threads of this process.
    """
    if not datasets:
        return
    files = [writer.files for writers in datasets for writer in writers]
    for of_camera in files:
        of_camera.make_folders(frames)
    # An 8K panorama, a face and encoded images take 130 MB.
    workers = (workers or Threads(os.cpu_count() or 1)).at_most(4)
    workers.must_see([of_camera.folder for of_camera in files])
    give_back_freed_memory(0)
    for _ in workers.map_shards(Pictures(frames, datasets)):
        pass


def panorama_writers(data: Dataset, files: Files) -> list[FrameWriter]:
    """Writers (C,) that copy the panoramas of each camera, and write masks if there are any.

    Panoramas that are corrected, those of raw pairs and of cube maps, and images that trainers
    misread are encoded again. Those of two lenses are stitched by `gsba.camera.one_centre`.
    """
    scenes = scenes_of(data.reconstruction)
    return [
        _Stitched(files, lenses, scenes) if lenses else _Panoramas(files, data.options.link)
        for lenses in data.cameras.lenses
    ]


@dataclass(frozen=True, slots=True)
class _Panoramas(FrameWriter):
    link: bool

    def __call__(self, shown: SharedPixels) -> None:
        as_it_is = shown.kind.layout == "erp" and not shown.kind.correction
        originals = shown.frames.paths[shown.f] if as_it_is else ()
        given = shown, "panorama", lambda: [shown.erp], lambda: [shown.mask]
        self.write(*given, originals=originals, link=self.link)


@dataclass(frozen=True, slots=True)
class _Stitched(_OfLenses):
    def __call__(self, shown: SharedPixels) -> None:
        @cache
        def stitcher() -> Stitcher:
            return Stitcher(self.lenses, shown.f, self.scenes(shown.f))

        def stitched() -> list[np.ndarray]:
            return [stitcher().stitched(shown.pictures(), shown.kind.width)]

        def mask() -> list[np.ndarray]:
            return [stitcher().stitched_mask(shown.mask)]

        self.write(shown, "stitched", stitched, mask, masks_differ=True)
