"""Layout of a recording: panoramas, images of two lenses, or a cube map at each instant.

Raw recordings of two fisheyes are one file with a track for each lens, two files with `_00_` and
`_10_` (GoPro Fusion: `GPFR` and `GPBK`) in their names, or one track with both circles side by
side, perhaps squeezed to 16:9. These layouts follow public descriptions (OpenSpeleo/insta360-rs,
docs/INSV_FORMAT.md; insta.pk360.de on file types); they were tested on two real files, one of them
black. The first track, `_00_` and the left circle are taken for the front lens; images keep the
rotation in which the camera stores them. GoPro's `.360` holds two tracks of a cube map, told by
their size: streams 0 and 5 of videos, 0 and 4 of time lapses.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import tee
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.equiangular import is_equiangular
from gsba.camera.factory_lenses import FactoryCalibration
from gsba.frames.factory_start import factory_calibration
from gsba.frames.files import turned
from gsba.frames.lens_names import lens_files
from gsba.frames.panorama_checks import OVER_UNDER, REMEDIES, unlike_panorama
from gsba.frames.scan import MAX_ROUNDING
from gsba.frames.side_by_side import (
    LOOKED_AT,
    SideBySide,
    lens_sizes,
    may_hold_two,
    one_beside_other,
    recognise,
    two_circles,
)
from gsba.log import GsbaError
from gsba.store.store import fingerprint
from gsba.trajectory.association import nearest
from gsba.types.records import spread_rows
from gsba.video.colours import bgr, luma
from gsba.video.timeline import (
    PictureClaims,
    Timeline,
    Track,
    decode,
    read_claims,
    read_timeline,
    track_sizes,
)

LENSES = ("front", "back")
EXACT_S = 1e-6  # closer times are equal

_RAW_SUFFIX = ".insv"  # of videos that hold fisheyes even if no image circle is detected
_STITCH = "stitch it in the camera's app and export an equirectangular (2:1) video"


@dataclass(frozen=True, slots=True)
class VideoPicture:
    """Panorama, or image of one lens; converted on access."""

    frame: Any  # av.VideoFrame
    place: tuple[slice, slice]  # its rows and columns in the frame
    height: int | None = None  # pixels, to which a squeezed image is stretched; None = not squeezed
    orientation: int = 1  # of EXIF, in which the stored image is shown

    def luma(self) -> np.ndarray:
        """Brightness (H, W) uint8."""
        return self._shown(luma(self.frame)[self.place])

    def bgr(self) -> np.ndarray:
        """Colours (H, W, 3) uint8 BGR."""
        return self._shown(bgr(self.frame)[self.place])

    def _shown(self, pixels: np.ndarray) -> np.ndarray:
        pixels = turned(pixels, self.orientation)
        if self.height is None:
            return np.ascontiguousarray(pixels)
        import cv2

        return cv2.resize(pixels, (pixels.shape[1], self.height), interpolation=cv2.INTER_AREA)


@dataclass(frozen=True, slots=True)
class VideoRecording:
    """One or two videos as instants, with numbers and times of the first track's frames."""

    tracks: tuple[Track, ...]  # (1), or (2) of front and back lens
    timelines: tuple[Timeline, ...]  # of the tracks
    places: tuple[tuple[slice, slice], ...]  # rows and columns of the panorama, or of both lenses'
    # images, in a frame
    width: int  # pixels across an image
    shown: np.ndarray  # (N,) bool, instants of which every track has a frame
    partners: np.ndarray  # (N,) int64, frame of the last track at instants that are `shown`
    notes: tuple[str, ...] = ()  # recognised layout, and left-out parts
    cube: bool = False  # True = two tracks of an equi-angular cube map, not two lenses
    height: int | None = None  # pixels, to which squeezed images are stretched; None = not squeezed
    orientation: int = 1  # of EXIF, in which stored panoramas are shown

    @property
    def times(self) -> np.ndarray:
        """Seconds (N,) float64 since the first frame of the first track."""
        return self.timelines[0].times

    @property
    def lenses(self) -> tuple[str, ...]:
        """Names of the lenses; () for panoramas and cube maps."""
        return LENSES if len(self.places) > 1 and not self.cube else ()

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of the two images of an instant; () for panoramas."""
        return TRACKS if self.cube else self.lenses


def files_of(video: Path) -> tuple[Path, ...]:
    """Files of the recording that `video` is of: that file, or those of the front and back lens.
    GsbaError: the file is no video, or has an unknown layout."""
    pair = lens_files(video)
    if pair is None or not all(path.is_file() for path in pair):
        return (video,)
    sizes = track_sizes(video)
    return pair if len(sizes) == 1 and _is_nearly_square(sizes[0]) else (video,)


def read_recording(video: Path) -> VideoRecording:
    """Recognise the layout of a video and read its times. GsbaError: the file is no video, holds
    neither panoramas nor a cube map nor two lenses, or its lenses or tracks do not match."""
    files = files_of(video)
    return _recognised(video, files, tuple(track_sizes(files[0])), fingerprint(files))


@lru_cache(maxsize=8)
def _recognised(
    video: Path, files: tuple[Path, ...], sizes: tuple[tuple[int, int], ...], _state: object
) -> VideoRecording:
    """Layout and times of the files of a video, in their state: to check, to follow and to extract
    it, all of its packets are read once."""
    size = sizes[0]
    if (cube := cube_tracks(files[0], sizes)) is not None:
        width, height = sizes[cube[0]]
        note = f"{video}: GoPro's equi-angular cube map, two tracks of {width}x{height}"
        tracks = Track(video, cube[0]), Track(video, cube[1])
        return _of_two_tracks(tracks, (width, height), note, cube=True)
    if len(files) == 2:
        front, back = files
        if (both := track_sizes(back)) != [size]:
            shapes = " and ".join(f"{width}x{height}" for width, height in both)
            raise GsbaError(
                f"{back} is {shapes}, but {front.name}, the front lens's file, is {size[0]}x"
                f"{size[1]}: they are no pair; copy both again from the camera, or {_STITCH}"
            )
        note = f"{files[0]}: raw, of the front lens; of the back one is {files[1]}"
        return _of_two_tracks((Track(files[0]), Track(files[1])), size, note)
    if len(sizes) > 1:
        # the two largest tracks, if they are square and equal, as in DJI's `.osv`
        largest = max(sizes, key=lambda size: size[0] * size[1])
        two = [n for n, size in enumerate(sizes) if size == largest]
        pair = two if len(two) == 2 and _is_nearly_square(largest) else list(range(len(sizes)))
        size = sizes[pair[0]]
        _check_tracks(video, [sizes[n] for n in pair])
        note = f"{video}: raw, two tracks of {size[0]}x{size[1]}: front lens, back lens"
        return _of_two_tracks((Track(video, pair[0]), Track(video, pair[1])), size, note)
    return _of_one_track(Track(video), size)


def factory_calibration_of(recording: VideoRecording) -> FactoryCalibration | None:
    """Maker's calibration in the files of a raw recording; None = there is none."""
    files = [track.path for track in recording.tracks]
    return factory_calibration(files, two_tracks=len(files) == 2 and files[0] == files[1])


def shots(
    recording: VideoRecording, chosen: Sequence[int]
) -> Iterator[tuple[int, tuple[VideoPicture, ...]]]:
    """Yield (instant, its images) of chosen instants, ascending and `shown`; damaged ones are left
    out."""
    frames = decode(recording.tracks[0], recording.timelines[0], chosen)
    if len(recording.tracks) == 1:
        for index, frame in frames:
            places = recording.places
            shape = recording.height, recording.orientation
            yield index, tuple(VideoPicture(frame, place, *shape) for place in places)
        return
    partners = recording.partners[list(chosen)].tolist()
    instants = dict(zip(partners, chosen, strict=True))
    others = decode(recording.tracks[1], recording.timelines[1], partners)
    other = next(others, None)
    for index, frame in frames:
        while other is not None and instants[other[0]] < index:
            other = next(others, None)
        if other is None:
            return
        if instants[other[0]] == index:
            pair = zip((frame, other[1]), recording.places, strict=True)
            yield index, tuple(VideoPicture(each, place) for each, place in pair)


def check_lengths(recording: VideoRecording) -> None:
    """GsbaError where one lens, or track, of a recording is clearly shorter than the other."""
    lasting = [float(line.times[-1]) + line.interval_s for line in recording.timelines]
    if min(lasting) >= 0.9 * max(lasting):
        return
    short, long = int(np.argmin(lasting)), int(np.argmax(lasting))
    end = recording.times[recording.shown][-1]
    if recording.cube:
        ours, theirs = f"pictures of {TRACKS[short]}", f"those of {TRACKS[long]}"
    else:
        ours, theirs = f"the {LENSES[short]} lens's pictures", f"the {LENSES[long]} one's"
    raise GsbaError(
        f"{recording.tracks[short].path}: {ours} last {lasting[short]:.3f} s, {theirs} "
        f"{lasting[long]:.3f} s: one is truncated; copy it again, or {advice_to_end_at(end)} to "
        "use the part of both"
    )


def advice_to_end_at(end_s: float) -> str:
    """Options by which commands end a video at a time, seconds."""
    return f"pass --to {end_s:.3f} (--set video.to_s={end_s:.3f} of refine and splat)"


def _is_nearly_square(size: tuple[int, int]) -> bool:
    return 0 < max(size) <= 1.1 * min(size)


def _check_tracks(video: Path, sizes: list[tuple[int, int]]) -> None:
    """Refuse several tracks that are not of two lenses."""
    (width, height), shapes = sizes[0], " and ".join(f"{w}x{h}" for w, h in sizes)
    if len(sizes) > 2:
        raise GsbaError(
            f"{video} holds {len(sizes)} video tracks, {shapes}; a recording of two lenses has "
            f"two: {_STITCH}"
        )
    if sizes[0] != sizes[1]:
        raise GsbaError(
            f"{video} holds video tracks of {shapes}; those of two lenses have one size: {_STITCH}"
        )
    if width == 2 * height:
        raise GsbaError(
            f"{video} holds two stitched video tracks of 2:1 ({shapes}): keep one "
            f"(ffmpeg -i {video.name} -map 0:v:0 -c copy ONE.mp4)"
        )
    if not _is_nearly_square(sizes[0]):
        raise GsbaError(
            f"{video} holds two video tracks of {width}x{height}, which are neither fisheyes "
            f"(square) nor panoramas (2:1): {_STITCH}"
        )


def _check_panorama(video: Path, size: tuple[int, int]) -> None:
    """Refuse a video that is not 2:1."""
    width, height = size
    if width == 2 * height and height > 0:
        return
    pair = lens_files(video) if _is_nearly_square(size) else None
    if pair is not None:
        other = pair[0] if video.name == pair[1].name else pair[1]
        raise GsbaError(
            f"{video} is {width}x{height}, one lens of a raw dual-fisheye recording, but "
            f"{other.name} is not beside it: copy the other lens's file there, or {_STITCH}"
        )
    if width == height and height > 0:
        raise GsbaError(
            f"{video} is {width}x{height}, square: one lens of a raw dual-fisheye recording, or "
            f"a stereo pair; {_STITCH}"
        )
    if abs(width - 2 * height) <= MAX_ROUNDING * width:
        raise GsbaError(
            f"{video} is {width}x{height}, nearly 2:1: if it is a whole panorama, scale it "
            f"(ffmpeg -i {video.name} -vf scale={width}:{width // 2} ONE.mp4)"
        )
    if height == 2 * width:
        raise GsbaError(
            f"{video} is {width}x{height}, a panorama on its side, or two pictures one above the "
            "other that show no image circles: turn it, or export an equirectangular (2:1) video"
        )
    raise GsbaError(
        f"{video} is {width}x{height}; an equirectangular video is 2:1. If it is raw "
        f"dual-fisheye or a reframed cut of the recording, {_STITCH}"
    )


def _of_one_track(track: Track, size: tuple[int, int]) -> VideoRecording:
    """Recording of panoramas, or of two lenses side by side or one above the other."""
    claims, timeline = read_claims(track), read_timeline(track)
    left, top, right, bottom = claims.bounds
    kind = ""
    if claims.stereo:
        kind = f"stereo, {claims.stereo}"
    elif claims.projection:
        kind = f"the projection '{claims.projection}', not equirectangular"
    elif any(claims.bounds):
        across, high = 360 * (1 - left - right), 180 * (1 - top - bottom)
        kind = f"a cropped panorama of {across:.0f} x {high:.0f} degrees"
    if kind:
        raise GsbaError(
            f"{track.path} holds {kind}, by its spherical video tags; gsba reads whole panoramas "
            "of one eye: export it so"
        )
    shown, looks = claims.shown_size(size), tee(_looks(track, timeline), 3)
    num, side = len(timeline.ticks), min(size[0], size[1] // 2)
    everything = np.ones(num, bool), np.arange(num)
    if 2 * size[0] == size[1] and two_circles(map(one_beside_other, looks[0]), track.path)[0]:
        note = f"{track.path}: raw, two fisheyes one above the other, front above"
        places = tuple((slice(at, at + side), slice(None)) for at in (0, side))
        notes = (note, *_hdr_notes(track.path, claims))
        return VideoRecording((track,), (timeline,), places, side, *everything, notes)
    found = recognise(looks[1], size, track.path)
    if found.lens_size is None and track.path.suffix.lower() == _RAW_SUFFIX and may_hold_two(size):
        note = f"{track.path}: raw, two fisheyes side by side, by its suffix"
        found = SideBySide(lens_sizes(size)[0], (note,))
    if found.lens_size is None:
        if not claims.whole:
            _refuse_stereo(track.path, shown, (turned(g, claims.orientation) for g in looks[2]))
        _check_panorama(track.path, shown)
        places = ((slice(None), slice(None)),)
        told = []
        if claims.orientation > 1:
            told.append(
                f"{track.path}: turned by its display matrix, EXIF orientation {claims.orientation}"
            )
        if claims.pixel_aspect != 1:
            told.append(f"{track.path}: pixels of {claims.pixel_aspect} are made square")
        told += _hdr_notes(track.path, claims)
        if any(claims.pose_deg):
            turn = ", ".join(f"{angle:g}" for angle in claims.pose_deg)
            told.append(
                f"{track.path}: players turn its panoramas by yaw, pitch, roll {turn} deg; they "
                "are read as stored"
            )
        notes = (*found.notes, *told)
        height = None if claims.pixel_aspect == 1 else shown[1]
        how = {"height": height, "orientation": claims.orientation}
        return VideoRecording((track,), (timeline,), places, shown[0], *everything, notes, **how)
    width, height = size
    side, unsqueezed = width // 2, None
    rows = slice(found.top, found.top + side)
    if found.lens_size[1] < height:
        rows, unsqueezed = slice(None), side
    places = (rows, slice(side)), (rows, slice(side, None))
    notes = (*found.notes, *_hdr_notes(track.path, claims))
    return VideoRecording(
        (track,), (timeline,), places, side, *everything, notes, height=unsqueezed
    )


def _refuse_stereo(video: Path, size: tuple[int, int], greys: Iterator[np.ndarray]) -> None:
    """Refuse pictures in 2:1, or square ones, that are no panoramas by what they show."""
    width, height = size
    kind = unlike_panorama(greys) if height in (width, width // 2) else ""
    if kind and (width == 2 * height or kind == OVER_UNDER):
        raise GsbaError(f"{video} holds no panoramas but {kind}: {REMEDIES[kind]}")


def _hdr_notes(video: Path, claims: PictureClaims) -> list[str]:
    """Note on pictures of HDR, which raw lenses may have, too."""
    if not claims.hdr:
        return []
    return [f"{video}: HDR ({claims.hdr}), converted to sRGB; brighter than white clips"]


def _of_two_tracks(
    tracks: tuple[Track, Track], size: tuple[int, int], note: str, cube: bool = False
) -> VideoRecording:
    """Recording of two lenses, or of two tracks of a cube map, whose frames are paired by time."""
    one, other = TRACKS if cube else LENSES
    kind = "track" if cube else "lens"
    front, back = read_timeline(tracks[0]), read_timeline(tracks[1])
    ahead = int(back.ticks[0]) * back.tick_s - int(front.ticks[0]) * front.tick_s
    ours, theirs = front.times, back.times + float(ahead)
    paired = nearest(theirs, ours)
    mutual = nearest(ours, theirs)[paired] == np.arange(len(ours))
    within = 0.5 * min(front.interval_s, back.interval_s) - EXACT_S
    shown = mutual & (np.abs(theirs[paired] - ours) < within)
    paths = dict.fromkeys(track.path for track in tracks)
    where = " and ".join(map(str, paths))
    if not shown.any():
        raise GsbaError(
            f"{where}: the {'tracks' if cube else 'lenses'} share no times ({one} 0 to "
            f"{ours[-1]:.3f} s, {other} {theirs[0]:.3f} to {theirs[-1]:.3f} s): they are not of "
            "one recording; copy it again from the camera"
        )
    hdr = [line for path in paths for line in _hdr_notes(path, read_claims(Track(path)))]
    notes, num = [note, *hdr], int(shown.sum())
    if num < max(len(ours), len(theirs)):
        notes.append(
            f"{where}: {len(ours) + len(theirs) - 2 * num} instants are left out, which only one "
            f"{kind} has ({len(ours) - num} {one}, {len(theirs) - num} {other})"
        )
    places, lines = ((slice(None), slice(None)),) * 2, (front, back)
    return VideoRecording(tracks, lines, places, size[0], shown, paired, tuple(notes), cube=cube)


def _looks(track: Track, timeline: Timeline) -> Iterator[np.ndarray]:
    """Grey pictures from all over a track, the middle one first: it suffices for most panoramas."""
    num = len(timeline.ticks)
    middle = num // 2
    others = set(spread_rows(num, LOOKED_AT).tolist()) - {middle}
    for part in ([middle], sorted(others)):
        for _, frame in decode(track, timeline, part):
            yield luma(frame)


TRACKS = ("track0", "track5")  # folders of their frames, by GoPro's numbers


def cube_tracks(video: Path, sizes: Sequence[tuple[int, int]]) -> tuple[int, int] | None:
    """Find the two tracks of an equi-angular cube map among those of a video, by their widths and
    heights; None if it holds none. GsbaError: a `.360` file does not hold exactly two such tracks
    of one size."""
    found = [n for n, size in enumerate(sizes) if is_equiangular(*size)]
    if len(found) == 2 and sizes[found[0]] == sizes[found[1]]:
        return found[0], found[1]
    panorama = len(sizes) == 1 and sizes[0][0] == 2 * sizes[0][1]
    if video.suffix.lower() != ".360" or panorama:
        return None
    shapes = " and ".join(f"{width}x{height}" for width, height in sizes)
    if len(sizes) == 1 and found:
        raise GsbaError(
            f"{video} holds one video track of {shapes}, but a .360 recording has two: the other "
            "half of the sphere is missing; copy the file again from the camera"
        )
    raise GsbaError(
        f"{video} holds video tracks of {shapes}; a .360 recording has two of one size, three "
        "squares wide and up to a twelfth more (4096x1344, 2272x736): copy it again from the "
        "camera, or export an equirectangular (2:1) video from GoPro Player"
    )
