"""Facts about a video: camera, layout, tracks, times, gyro, positions, lenses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.containers.insta360 import Insta360Trailer, read_trailer
from gsba.imu.files import read_telemetry
from gsba.log import GsbaError
from gsba.placement.gps_video import read_video_gps
from gsba.video.extraction import refuse_darkness
from gsba.video.recording import VideoRecording, read_recording
from gsba.video.timeline import container_tags

Facts = tuple[tuple[str, str], ...]  # name and text of each, in the order of the output


@dataclass(frozen=True, slots=True)
class Found:
    """Facts about a path, and its problem if it cannot be refined."""

    facts: Facts
    problem: str = ""  # reason why it cannot be refined; "" = it can


def spoken_seconds(duration_s: float) -> str:
    """Text of a duration: seconds, or minutes and seconds."""
    if duration_s < 100:
        return f"{duration_s:.3g} s"
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes} min {seconds} s"


_MAX_INTERVAL_RATIO = 1.5  # longest over median frame interval of a constant frame rate


def of_video(path: Path) -> Found:
    """Facts about a video; fewer facts and the problem if it would be refused."""
    trailer = read_trailer(path)
    try:
        recording = read_recording(path)
    except GsbaError as error:
        return Found((*_camera(path, trailer), *_sensors(path, trailer)), str(error))
    facts = (
        *_camera(path, trailer),
        ("layout", _layout(recording)),
        *(("files", track.path.name) for track in recording.tracks[1:] if track.path != path),
        ("frames", _frames(recording)),
        *_sensors(path, trailer),
    )
    try:
        refuse_darkness(path, recording, np.flatnonzero(recording.shown).tolist())
    except GsbaError as error:
        return Found(facts, str(error))
    return Found(facts)


def _camera(path: Path, trailer: Insta360Trailer | None) -> Facts:
    """Maker, model and firmware, and the recording's date."""
    if trailer is not None:
        firmware = f", firmware {trailer.firmware}" if trailer.firmware else ""
        return (("camera", f"{trailer.model or 'Insta360'}{firmware}"),)
    tags = container_tags(path)
    named = [tags[key] for key in ("make", "model", "firmware") if tags.get(key)]
    created = tags.get("creation_time")
    facts = [("camera", " ".join(named))] if named else []
    return (*facts, *([("created", created)] if created else []))


def _layout(recording: VideoRecording) -> str:
    """Layout of the frames."""
    line = recording.timelines[0]
    if recording.cube:
        return f"equi-angular cube map, two tracks of {line.width}x{line.height}"
    if not recording.lenses:
        return f"stitched panoramas, {line.width}x{line.height}"
    tracks = "two tracks or files" if len(recording.tracks) > 1 else "side by side"
    return f"raw, two fisheyes, {tracks} of {line.width}x{line.height}"


def _frames(recording: VideoRecording) -> str:
    """Number of frames, rate and duration."""
    times, num = recording.times, int(np.count_nonzero(recording.shown))
    steps = np.diff(times)
    varying = len(steps) and steps.max() > _MAX_INTERVAL_RATIO * np.median(steps)
    rate = 1 / recording.timelines[0].interval_s
    end = float(times[-1]) + recording.timelines[0].interval_s
    about = "about " if varying else ""
    return f"{num}, {about}{rate:.5g} a second, {spoken_seconds(end)}"


def _sensors(path: Path, trailer: Insta360Trailer | None) -> Facts:
    """Gyro, positions, and the maker's data on exposures and lenses."""
    facts = [("gyro", _gyro(path)), ("GPS", _gps(path))]
    if trailer is None:
        return tuple(facts)
    if trailer.exposures is not None:
        times = 1e3 * trailer.exposures.durations
        facts.append(("exposures", f"{len(times):,}, {times.min():.3g} to {times.max():.3g} ms"))
    if trailer.readout_s is not None:
        facts.append(("readout", f"{1e3 * trailer.readout_s:.4g} ms, by the maker"))
    known = "none in the file"
    if trailer.lens_strings:
        known = "by the maker, refined from the images"
    return (*facts, ("calibration", known), *(("note", note) for note in trailer.notes))


def _gyro(path: Path) -> str:
    try:
        readings = read_telemetry(path)
    except GsbaError as error:
        return _nothing(path, error)
    rate = 1 / float(np.median(np.diff(readings.timestamps)))
    beside = " with accelerometer" if readings.forces is not None else ""
    return f"{len(readings.timestamps):,} readings at {rate:.0f} Hz{beside}"


def _gps(path: Path) -> str:
    try:
        fixes = read_video_gps(path)
    except GsbaError as error:
        return _nothing(path, error)
    return f"{len(fixes.geodetic):,} fixes, {np.median(fixes.sigmas[:, 0]):.2g} m across (1 sigma)"


def _nothing(path: Path, error: GsbaError) -> str:
    """Entry of data that were not found, or not looked for without the library that reads them."""
    missing = isinstance(error.__cause__ or error.__context__, ImportError)
    return f"{'not checked' if missing else 'none'}: {str(error).removeprefix(f'{path}: ')}"
