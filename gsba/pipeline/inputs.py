"""What a run starts from, as its caller names it: files of poses, and frames of a video."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba import odometry, video
from gsba.bundle.families import Family
from gsba.bundle.gps_factors import MIN_FIXES, FrameFixes, GpsFactors
from gsba.camera.calibration import read_calibration
from gsba.compilation import compile_ahead
from gsba.config import RefineSettings, VideoSettings, installed_families
from gsba.frames.image_circles import ImageCircle
from gsba.frames.lens_names import lens_files
from gsba.frames.times import check_fps
from gsba.geometry import local_origin
from gsba.imu.files import read_imu, read_telemetry
from gsba.imu.readings import Readings
from gsba.log import GsbaError
from gsba.masks.merging import Choice
from gsba.odometry.walk import Odometry, write_chosen, write_odometry
from gsba.placement import EXIF, check, fixes_of_frames, read_fixes
from gsba.report.time_left import tell_size
from gsba.store.store import RunStore, fingerprint
from gsba.trajectory.association import follow_keyframes, without_trajectory
from gsba.trajectory.conventions import Convention
from gsba.trajectory.files import is_kitti, read_trajectory
from gsba.trajectory.metashape import NamedPoses, is_metashape, read_metashape
from gsba.trajectory.misread import refuse_useless
from gsba.trajectory.restarts import associate_pieces, split_restarts, without_lost_frames
from gsba.types import CoarsePoses, FrameSet, Trajectory
from gsba.video.recording import files_of
from gsba.video.timeline import track_sizes

logger = logging.getLogger(__name__)

_WITH_GYRO = (".insv", ".osv", ".360")  # raw videos that may hold readings
CHOSEN = Path("odometry/chosen.tum")  # in a run's folder: frames that the odometry has chosen
# Odometry is lost in videos of frames far apart, as time lapses are: so many are matched as stills.
_FRAMES_OF_A_LOST_VIDEO = 300


def trajectory_files(
    trajectory: Path | str | Sequence[Path | str] | None, keyframes: Path | None
) -> dict[str, Path]:
    """The files that poses come from, by what they are."""
    given = [trajectory] if isinstance(trajectory, Path | str) else list(trajectory or ())
    if keyframes is not None and not given:
        raise GsbaError(
            f"keyframes {keyframes} need the trajectory of the same SLAM run: give both"
        )
    if keyframes is not None and len(given) > 1:
        raise GsbaError("keyframes go with one trajectory: give either several, or keyframes")
    origin = {f"trajectory{n or ''}": Path(path) for n, path in enumerate(given)}
    return origin if keyframes is None else origin | {"keyframes": Path(keyframes)}


def read_trajectories(
    origin: Mapping[str, Path], timestamps: Path | None, convention: Convention
) -> list[Trajectory | NamedPoses]:
    """The trajectories of the files of a run, in pieces that each have a world of their own; poses
    of Metashape's cameras, whose convention is known, get their times by `timed`. GsbaError for
    timestamps beside a video that are not of KITTI's rows, too."""
    given = [path for name, path in origin.items() if name.startswith("trajectory")]
    if any(map(is_metashape, given)):
        if convention != Convention():
            raise GsbaError("--trajectory-format is of text files; that of cameras.xml is known")
        if "keyframes" in origin:
            raise GsbaError("--keyframes goes with a SLAM's trajectory, not with cameras.xml")
        if not all(map(is_metashape, given)):
            raise GsbaError("give either trajectories with times, or cameras.xml, not both")
        if video.is_video(origin["frames"]):
            raise GsbaError(
                f"{given[0]}: its cameras go by file names: give the folder of the pictures that "
                "were aligned, not a video"
            )
        return [component for path in given for component in read_metashape(path)]

    if (
        timestamps is not None
        and video.is_video(origin["frames"])
        and not any(is_kitti(path) for name, path in origin.items() if name != "frames")
    ):
        held = "the times of its frames" + (", and its trajectory its own" if given else "")
        raise GsbaError(f"a video holds {held}: leave out --timestamps")

    def read(path: Path) -> Trajectory:
        return convention.poses(read_trajectory(path, timestamps))

    pieces = [without_lost_frames(read(path)) for path in given]
    if "keyframes" in origin:
        pieces = [follow_keyframes(pieces[0], read(origin["keyframes"]))]
    # A new map begins at the identity, in the camera axes of the file.
    return [convention.in_our_axes(part) for piece in pieces for part in split_restarts(piece)]


def timed(given: Sequence[Trajectory | NamedPoses], frames: FrameSet) -> list[Trajectory]:
    """Trajectories at the times of frames, those by file names too, each in a world near its
    origin; GsbaError if fewer than two frames have a pose of a file."""
    known = [one.timed(frames) if isinstance(one, NamedPoses) else one for one in given]
    for n, one in enumerate(known):
        origin = local_origin(one.world_T_rigs[:, :3, 3])
        if origin is not None:  # as of ECEF and UTM
            logger.info(
                "the trajectory is far from its origin: the run's world is shifted by %s, which "
                "transform.json states",
                ", ".join(f"{value:.12g}" for value in origin),
            )
            poses = one.world_T_rigs.copy()
            poses[:, :3, 3] -= origin
            known[n] = replace(one, world_T_rigs=poses, origin=origin)
    return known


def coarse_poses(
    frames: FrameSet, given: Sequence[Trajectory], settings: RefineSettings
) -> CoarsePoses:
    """Start poses of frames, refused where no video could have them."""
    if not given:
        return without_trajectory(frames)
    coarse = associate_pieces(frames, given, settings.read)
    refuse_useless(coarse)
    # an extent that is rounding alone
    if np.ptp(coarse.world_T_rigs[:, :3, 3], axis=0).max() < 1e-9:
        logger.warning("the trajectory only turns: positions come from the images alone")
        return without_trajectory(frames)
    return coarse


def for_odometry(settings: RefineSettings) -> RefineSettings:
    """Settings for frames that the odometry of their own video chose: its poses are no evidence,
    and more frames are fetched where the map of usual keypoints turns out to be weak."""
    settings, weak = settings.with_faint_priors(), settings.weak_frames
    if weak.mode != "auto":
        return settings
    measured = weak.model_copy(update={"mode": "measured"})
    return settings.model_copy(update={"weak_frames": measured})


def with_baseline(settings: RefineSettings, calibration: Path | None) -> RefineSettings:
    """Settings with the distance between the first two lenses by a calibration, unless given."""
    if calibration is None:
        return settings
    front, other = (np.array(lens.centre) for lens in read_calibration(calibration)[:2])
    millimetres = 1e3 * float(np.linalg.norm(front - other))
    if settings.camera.baseline() is not None or not millimetres:
        return settings
    if not 2 <= millimetres <= 200:
        raise GsbaError(
            f"{calibration}: its lenses are {millimetres:.4g} mm apart, which no camera's are: "
            'lengths are metres, unless the file says "unit": "map"'
        )
    camera = settings.camera.model_copy(update={"baseline_mm": millimetres})
    return settings.model_copy(update={"camera": camera})


def read_gyro(imu: Path | None, frames: Path) -> Readings | None:
    """Readings that a run is given, or that its raw video holds; a video without them, or without
    the library that reads them, is taken as it is. GsbaError if `imu` cannot be used."""
    if imu is not None:
        return read_imu(imu)
    pair = lens_files(frames)
    if not frames.is_file() or (frames.suffix.lower() not in _WITH_GYRO and pair is None):
        return None
    errors = []
    for path in filter(Path.is_file, pair or (frames,)):  # of a pair, either may have it
        try:
            duration_s = None  # of a video that cannot be read, which its extraction tells
            with suppress(GsbaError):
                duration_s = video.claimed_duration_s(path)
            found = read_telemetry(path, duration_s)
        except GsbaError as error:
            errors.append(error)
            continue
        every = float(np.median(np.diff(found.timestamps)))
        logger.info("%s: gyro, %d readings at %.0f Hz", path, len(found.timestamps), 1 / every)
        return found
    logger.info("no gyro: %s", errors[0])
    return None


def families_of(frames: FrameSet, settings: RefineSettings) -> list[Family]:
    """GPS fixes and families that packages provide, as settings.factors name them; GsbaError if one
    cannot be made."""
    fixes = positions_of(frames, settings)
    made: list[Family] = [] if fixes is None else [GpsFactors(fixes)]
    for named in settings.package_families():
        name, _, argument = named.partition(":")
        try:
            make = installed_families()[name].load()
        except (ImportError, AttributeError) as error:
            raise GsbaError(f"family {name}: its package cannot be loaded: {error}") from error
        made.append(make(frames, argument or None))
    return made


def positions_of(frames: FrameSet, settings: RefineSettings) -> FrameFixes | None:
    """GPS fixes of frames for the gps factors, None = not asked for; positions that exports are to
    be placed by are read, too. GsbaError if they cannot be used, or too few frames have one."""
    check(settings.placement, frames, settings.camera.baseline())
    source = settings.gps.file
    if source is None:
        return None
    fixes = fixes_of_frames(source, frames, settings.gps)
    if len(fixes) < MIN_FIXES:
        raise GsbaError(
            f"--gps {source}: {len(fixes)} of {len(frames)} frames have a position, and "
            f"{MIN_FIXES} are needed: check that they are of this recording and on the frames' "
            "clock"
        )
    logger.info("--gps %s: %d of %d frames have a position", source, len(fixes), len(frames))
    return fixes


def follows(
    settings: VideoSettings, fps: float | None, odometry: bool | None, given: Sequence[object]
) -> bool:
    """Whether a video is followed by odometry: as asked, else where nothing says which frames of it
    to take; never where trajectories are given."""
    if given:
        return False
    if odometry is not None:
        return odometry
    asked = (settings.fps, settings.every, settings.at)
    return fps is None and asked == (VideoSettings().fps, None, None) and not settings.sharpest


def check_positions(settings: RefineSettings) -> None:
    """Refuse positions that the frames of a video cannot have, before hours of decoding."""
    if EXIF in (settings.placement.gps, settings.gps.file):
        raise GsbaError("--gps exif: a video's frames have no tags; give positions as a file")
    if settings.gps.file is not None:
        read_fixes(settings.gps.file)


def extract_video(
    store: RunStore,
    video_file: Path,
    settings: RefineSettings,
    fps: float | None,
    by_odometry: Choice | None = None,
    calibration: Path | None = None,
    circles: Sequence[ImageCircle] = (),
    name: str = "",
) -> Odometry | None:
    """Write the frames of a video to `frames` in the run's folder.

    Args:
        fps: frames kept per second; None = as the settings say.
        by_odometry: choose the frames by what the video's own odometry shows under these masks;
            None = by the settings.
        calibration, circles: of the lenses of a raw video, for the odometry.
        name: of one of several recordings, whose frames go to `frames`/`name`; "" = the only one.

    Returns:
        The odometry that frames were chosen by; None = not asked for, or it found too little.
    """
    compile_ahead(*([] if by_odometry is None else ["odometry"]), "refine")
    chosen, folder = settings.video, store.root / "frames" / name
    if fps is not None:
        chosen = chosen.model_copy(update={"fps": check_fps(fps), "every": None, "at": None})
    found: Odometry | None = None
    if by_odometry is not None:
        tell_size(settings, None, track_sizes(video_file)[0][0], False)
        found = _follow(store, video_file, settings, by_odometry, calibration, circles, name)
        if found.usable():
            rows = odometry.choose_frames(found, settings.odometry)
            logger.info("%d of %d frames chosen by what they show", len(rows), len(found))
            followed = store.root / CHOSEN.parent / name
            files = "walk.tum", "keyframes.tum", "poses.csv", "odometry.json"
            write_odometry(found, *(followed / file for file in files))
            at = followed / CHOSEN.name
            write_chosen(found, rows, at)
            store.claim(followed)
            chosen = chosen.model_copy(update={"at": str(at), "sharpest": False})
        else:
            times = found.timestamps
            fps = max(chosen.fps, _FRAMES_OF_A_LOST_VIDEO / max(times[-1] - times[0], 1.0))
            logger.warning("the odometry lost the camera in most of the video: frames are stills")
            chosen, found = chosen.model_copy(update={"fps": fps}), None
    folder.parent.mkdir(parents=True, exist_ok=True)
    video.extract(video_file, folder, chosen, replace=True)
    store.claim(folder)
    return found


def _follow(
    store: RunStore,
    video_file: Path,
    settings: RefineSettings,
    masks: Choice,
    calibration: Path | None,
    circles: Sequence[ImageCircle],
    name: str,
) -> Odometry:
    """Odometry of a video."""
    start, end = settings.video.from_s, settings.video.to_s
    seed = settings.seed
    stage = f"odometry@{name}" if name else "odometry"

    def compute() -> Odometry:
        video.check_video(video_file, settings.video)
        panoramas = odometry.of_video(video_file, odometry.WIDTH, calibration, start, end, circles)
        if masks.given is not None and masks.given.is_file():
            panoramas = odometry.masked(panoramas, masks.given)
        if masks.carrier:
            panoramas = odometry.without_carrier(panoramas)
        unfinished = store.root / "stages" / stage / "unfinished.npz"
        return odometry.track_panoramas(panoramas, seed, checkpoint=unfinished)

    files = fingerprint([*files_of(video_file), calibration, masks.given])
    key = [odometry.WIDTH, seed, (start, end), masks.carrier, files, *map(repr, circles)]
    return store.stage(stage, key, compute, Odometry)
