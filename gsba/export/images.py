"""Images and masks of an export, a few frames in memory at a time.

Faces are cut with bicubic sampling, low-passed first where they are much coarser than the
panorama. They are written with 8 bits and three colours: as PNG where the frame is PNG or TIFF,
else as JPEG of quality 95. Images that leave unchanged (panoramas; faces that came as faces of the
same size; if every trainer reads them as we do) are copies, which share their place on disk with
the original where the file system can (reflinks): an export may be moved and edited. On request
they are hard links: then an edit of one is an edit of the other.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.camera.one_centre import Stitcher
from gsba.camera.rig import CubeRig
from gsba.camera.views import View, ViewCutter
from gsba.export.pictures import Pictures, Shown
from gsba.frames.buffers import give_back_freed_memory
from gsba.frames.dual_fisheye import load_raw
from gsba.frames.files import goes_out_as_it_is
from gsba.frames.pixels import load_faces
from gsba.log import GsbaError, track
from gsba.types import FACES, FrameSet

MIN_FACE_SIZE = 16  # pixels
_FICLONE = 0x40049409  # of Linux: a file that shares another's blocks until one is written to
_INSTEAD = {".webp": ".jpg", ".tif": ".png", ".tiff": ".png"}
_AT_ONCE = 4  # frames at most: an 8K panorama, a face and what is encoded take 130 MB

FrameWriter = Callable[[Shown], None]  # writes what a dataset shows of a frame


def face_size_for(frames: FrameSet, face_size: int | None) -> int:
    """Pixels of an exported face: as asked, else as many around the horizon as the frame has.

    That is a quarter of a panorama's width, rounded to an even number: the mean resolution is
    kept (a face centre is sampled 1.27 times coarser than the panorama, an edge 1.57 times
    finer). Frames that come as faces keep their size.
    """
    if face_size is None:
        return 2 * round(frames.width / 8) if frames.panoramic else frames.width
    if face_size < MIN_FACE_SIZE:
        raise GsbaError(f"face size {face_size} is too small: use {MIN_FACE_SIZE} pixels or more")
    return face_size


def of_one_lens(images: str, frames: FrameSet) -> bool:
    """Whether two lenses are told apart where they are known, as `export.images` says it."""
    return images in ("lenses", "fisheye", "panorama") or (
        images == "auto" and frames.fisheyes is not None
    )


def suffix_of(frames: FrameSet, f: int) -> str:
    """Suffix of the exported images of a frame: that of the input, or a kind that all can read."""
    suffix = frames.paths[f][0].suffix
    return _INSTEAD.get(suffix.lower(), suffix)


def has_masks(frames: FrameSet) -> bool:
    """Whether any frame has a mask; then every exported image gets one."""
    return any(path is not None for path in frames.mask_paths)


def view_writer(
    frames: FrameSet,
    views: tuple[View, ...],
    lenses: Lenses,
    image_path: Callable[[int, str], Path],
    mask_path: Callable[[int, str], Path],
    link: bool = False,
    scenes: Callable[[int], np.ndarray] | None = None,
) -> FrameWriter:
    """Writes every view of a frame, and its mask where the frames have masks.

    Args:
        frames: panoramas, or faces of which the missing ones stay missing.
        views: of `gsba.camera.views.views_for`.
        lenses: of these frames.
        image_path: file of the image, by frame index and view name.
        mask_path: file of the mask (PNG, 0 = ignore, 255 = use).
        link: hard links to images that leave unchanged.
        scenes: points (N, 3) around a frame, rig frame, by its index: how far things are.
    """
    if lenses and frames.panoramic:
        return _lens_face_writer(frames, views, lenses, image_path, mask_path, scenes)
    return _cube_face_writer(frames, views[0].width, image_path, mask_path, link)


def _cube_face_writer(
    frames: FrameSet,
    size: int,
    image_path: Callable[[int, str], Path],
    mask_path: Callable[[int, str], Path],
    link: bool,
) -> FrameWriter:
    from gsba.frames import cubemap

    rig, faces = CubeRig(size, np.pi / 2), frames.faces or FACES
    chosen = [FACES.index(face) for face in faces]

    def write(shown: Shown) -> None:
        f = shown.f
        paths = [image_path(f, face) for face in faces]
        if frames.panoramic:
            room = shown.room("face", (size, size, 3))
            shown.write(size, paths, lambda: cubemap.cut_padded(shown.padded, rig, room))
        elif size == frames.width and all(map(goes_out_as_it_is, frames.paths[f], paths)):
            for source, path in zip(frames.paths[f], paths, strict=True):
                pass_on(source, path, link)
        else:
            shown.write(size, paths, lambda: _resized(load_faces(frames, f), size))
        if has_masks(frames):
            masks = [mask_path(f, face) for face in faces]
            shown.write_masks(size, masks, lambda: cut_mask(f, shown)[chosen])

    def cut_mask(f: int, shown: Shown) -> np.ndarray:
        if frames.mask_paths[f] is None:
            return np.ones((len(FACES), size, size), bool)
        return cubemap.cut_mask(shown.mask, rig)

    return write


def _lens_face_writer(
    frames: FrameSet,
    views: tuple[View, ...],
    lenses: Lenses,
    image_path: Callable[[int, str], Path],
    mask_path: Callable[[int, str], Path],
    scenes: Callable[[int], np.ndarray] | None,
) -> FrameWriter:
    def write(shown: Shown) -> None:
        f = shown.f

        @cache
        def cutter() -> ViewCutter:
            return ViewCutter(views, lenses, f, None if scenes is None else scenes(f))

        def cut() -> Iterator[np.ndarray]:
            if frames.fisheyes is not None:
                return cutter().cut_raw(load_raw(frames, f))
            return cutter().cut_padded(shown.padded)

        def cut_mask() -> Iterator[np.ndarray]:
            return (part.astype(np.uint8) * 255 for part in cutter().cut_mask(shown.mask))

        size = views[0].width
        shown.write(("of lenses", size), [image_path(f, view.name) for view in views], cut)
        if has_masks(frames):
            paths = [mask_path(f, view.name) for view in views]
            shown.write(("masks of lenses", size), paths, cut_mask)

    return write


def write_pictures(frames: FrameSet, writers: Sequence[FrameWriter]) -> None:
    """Write what all datasets of an export show, frame by frame."""
    pictures = Pictures(frames)

    def write(f: int) -> None:
        shown = Shown(pictures, f)
        for writer in writers:
            writer(shown)

    if writers:
        give_back_freed_memory()
        of_all_frames(write, len(frames))


def of_all_frames(write: Callable[[int], None], num_frames: int) -> None:
    """Write frames, a few at a time."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, _AT_ONCE)) as pool:
        running = [pool.submit(write, f) for f in range(num_frames)]
        try:
            for future in track(running, "writing images"):
                future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def panorama_writer(
    frames: FrameSet,
    image_path: Callable[[int], Path],
    mask_path: Callable[[int], Path],
    link: bool = False,
    lenses: Lenses = ONE_CENTRE,
    scenes: Callable[[int], np.ndarray] | None = None,
) -> FrameWriter:
    """Copies the panorama of a frame, and writes its mask where the frames have masks.

    Panoramas that are corrected, those of raw pairs, and images that trainers misread are written
    anew; those of two lenses are stitched by `gsba.camera.one_centre`.

    Args:
        frames: panoramas.
        image_path: file of the image, by frame index.
        mask_path: file of the mask (PNG, 0 = ignore, 255 = use).
        link: hard links instead of copies.
        lenses: of these frames.
        scenes: points (N, 3) around a frame, rig frame, by its index: how far things are.
    """
    if lenses:
        return _stitched_writer(frames, image_path, mask_path, lenses, scenes)

    def write(shown: Shown) -> None:
        f = shown.f
        source, path = frames.paths[f][0], image_path(f)
        as_it_is = not (frames.correction or frames.fisheyes) and goes_out_as_it_is(source, path)
        if as_it_is:
            pass_on(source, path, link)
        else:
            shown.write("panorama", [path], lambda: [shown.erp])
        if has_masks(frames):
            shown.write_masks("panorama", [mask_path(f)], lambda: [shown.mask])

    return write


def _stitched_writer(
    frames: FrameSet,
    image_path: Callable[[int], Path],
    mask_path: Callable[[int], Path],
    lenses: Lenses,
    scenes: Callable[[int], np.ndarray] | None,
) -> FrameWriter:
    def write(shown: Shown) -> None:
        f = shown.f

        @cache
        def stitcher() -> Stitcher:
            return Stitcher(lenses, f, np.zeros((0, 3)) if scenes is None else scenes(f))

        def stitched() -> list[np.ndarray]:
            if frames.fisheyes is not None:
                return [stitcher().stitched_raw(load_raw(frames, f), frames.width)]
            return [stitcher().stitched(shown.erp)]

        def mask() -> list[np.ndarray]:
            return [stitcher().stitched_mask(shown.mask).astype(np.uint8) * 255]

        shown.write("stitched", [image_path(f)], stitched)
        if has_masks(frames):
            shown.write("stitched mask", [mask_path(f)], mask)

    return write


def pass_on(source: Path, path: Path, link: bool) -> None:
    """Give `path` the content of `source`; without a second one on disk where that can be."""
    if not source.is_file():
        raise GsbaError(f"{source}: is gone; it was there when the run began")
    path.parent.mkdir(parents=True, exist_ok=True)
    if link:
        with suppress(OSError):  # another file system
            os.link(source.resolve(), path)
            return
    with suppress(OSError), source.open("rb") as original, path.open("wb") as clone:
        fcntl.ioctl(clone, _FICLONE, original.fileno())
        return
    shutil.copyfile(source, path)


def _resized(faces: np.ndarray, size: int) -> np.ndarray:
    import cv2

    how = cv2.INTER_AREA if size < faces[0].shape[0] else cv2.INTER_CUBIC
    return np.stack([cv2.resize(face, (size, size), interpolation=how) for face in faces])
