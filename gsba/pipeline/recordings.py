"""A run from several recordings of a place to one world of refined poses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from gsba import video
from gsba.bundle.families import Family
from gsba.config import CameraSettings, RefineSettings
from gsba.config_file import validated
from gsba.frames.recordings import combine
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks import merging
from gsba.masks.segmentation import Segment
from gsba.pipeline import inputs
from gsba.pipeline.each_recording import naming_recording
from gsba.pipeline.outputs import RunResult
from gsba.pipeline.refine import Start, refine_from
from gsba.pipeline.run import Evidence, RecordingEvidence
from gsba.pipeline.stage_titles import title_of
from gsba.placement import check
from gsba.store import cluster
from gsba.store.store import RunStore, StageRecord
from gsba.trajectory.conventions import Convention
from gsba.trajectory.metashape import NamedPoses
from gsba.types import FrameSet, RunStart, Trajectory

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording of a place, with a clock, a trajectory and a gyro of its own.

    Paths may be text. Fields without a comment are those of `gsba.refine`.
    """

    frames: Path | str  # folder of frames, or a video
    trajectory: Path | str | Sequence[Path | str] | None = None
    name: str = ""  # folder of its frames in exports; "" = that of its folder or video
    keyframes: Path | str | None = None
    masks: merging.Masks = merging.AUTO
    timestamps: Path | str | None = None
    fps: float | None = None
    calibration: Path | str | None = None
    circles: Sequence[tuple[float, float, float]] = ()
    imu: Path | str | None = None
    odometry: bool | None = None
    camera: str | None = None  # camera model, as the setting camera.name; None = not known


def names_of(recordings: Sequence[Recording]) -> list[str]:
    """A name for each recording: its own, else that of its folder or video, with its parent's
    before it where several have one. GsbaError if two recordings still have one name."""
    paths = [Path(one.frames).resolve() for one in recordings]
    for path in paths:
        if paths.count(path) > 1:
            raise GsbaError(f"recording {path} is given twice: give each one once")
    stems = [path.stem if path.is_file() else path.name for path in paths]
    names = []
    for one, path, stem in zip(recordings, paths, stems, strict=True):
        repeated = stems.count(stem) > 1
        names.append(one.name or (f"{path.parent.name}-{stem}" if repeated else stem))
    for name in names:
        if names.count(name) > 1:
            places = [str(path) for path, other in zip(paths, names, strict=True) if other == name]
            raise GsbaError(
                f"recordings {places[0]} and {places[1]} are both named '{name}': give each a name "
                "(name=NAME)"
            )
    return names


@threadpool_limits.wrap(limits=1, user_api="blas")  # frames have threads; sums keep their order
def refine_recordings(
    recordings: Sequence[Recording],
    out: Path | str,
    settings: RefineSettings | None = None,
    *,
    segment: Segment | None = None,
    fresh: bool = False,
    families: Sequence[Family] = (),
    client: "Client | None" = None,
) -> RunResult:
    """Refine the poses of several recordings of a place in one world with one scale.

    Recordings are joined by the places that they share; those that share none stay maps of their
    own. The world is that of the first recording with a trajectory.

    Args:
        recordings: at least two, each on a clock of its own. Those of one layout, size and
            calibration are of one camera, unless they name different ones.
        out, settings, segment, fresh, families, client: see `gsba.refine`.

    Raises:
        GsbaError: a recording or a setting that cannot be used; the message names the recording.
    """
    if len(recordings) < 2:
        raise GsbaError("give two recordings or more; gsba.refine refines one")
    given = {"segment": segment, "fresh": fresh, "families": families, "client": client}
    return refine_each(recordings, Path(out), settings, **given)


def refine_each(
    recordings: Sequence[Recording],
    out: Path,
    settings: RefineSettings | None = None,
    *,
    segment: Segment | None = None,
    fresh: bool = False,
    families: Sequence[Family] = (),
    client: "Client | None" = None,
    adapt: Callable[[Mapping[str, FrameSet]], Mapping[str, tuple[FrameSet, CameraSettings]]]
    | None = None,
) -> RunResult:
    """Refine recordings, one or more, in one run as `refine_recordings` does. `adapt` gives frames
    as they are to be read, and settings of their camera, from frames by the name of their
    recording."""
    plain = settings or RefineSettings()
    convention = Convention.parse(plain.read.trajectory_format)
    given = [
        _Given.of(one, name, convention)
        for one, name in zip(recordings, names_of(recordings), strict=True)
    ]
    settings = _with_camera(plain, given)
    check(settings.placement, baseline=settings.camera.baseline())
    # Sources of masks of all recordings; files belong to each recording alone.
    choices = {one.name: merging.choose(one.recording.masks, segment) for one in given}
    every = list(choices.values())
    chosen = merging.Choice(
        None,
        any(one.carrier for one in every),
        any(one.distractors for one in every),
        segment,
        any(one.carrier_required for one in every),
        tuple(name for name, one in choices.items() if not one.carrier),
    )
    origin = {name: path for one in given for name, path in one.files.items()}
    given, fresh, extracted = _with_videos(given, out, origin, settings, fresh)
    found = {one.name: one.scanned() for one in given}
    plain_of = dict.fromkeys(found, plain)
    if adapt is not None:
        read = adapt(found)
        found = {name: frames for name, (frames, _) in read.items()}
        plain_of = {
            name: plain.model_copy(update={"camera": own}) for name, (_, own) in read.items()
        }
        settings = _with_camera(plain_of[given[0].name], given)
    if any(one.followed for one in given):  # no evidence beside the images that they are made of
        settings = settings.with_faint_priors()
    models = {one.name: one.recording.camera for one in given}
    frames = combine(found, {name: model for name, model in models.items() if model})
    evidence = Evidence(
        families=tuple(families),
        recordings=tuple(
            one.evidence(found[one.name], settings, plain_of[one.name]) for one in given
        ),
    )
    start = Start.of(frames, evidence, settings)
    hired = cluster.hire(client, frames.paths[0][0], settings)
    with RunStore(out, origin, fresh, hired, title_of) as store:
        store.records.update(extracted)  # their time is the run's, too
        return refine_from(store, settings, chosen, evidence, start, given[0].folder, None)


@dataclass(frozen=True, slots=True)
class _Given:
    """A recording with its name, its files, and what was read of them."""

    name: str
    recording: Recording
    files: dict[str, Path]  # inputs of the run by what they are
    trajectories: tuple[Trajectory | NamedPoses, ...]  # in pieces, each with its own world
    folder: Path  # of its frames, or its video
    extracted: bool = False  # True if its frames were extracted from a video
    followed: bool = False  # True if the trajectory is odometry of its own images

    @classmethod
    def of(cls, recording: Recording, name: str, convention: Convention) -> "_Given":
        """A recording whose trajectory files are read, before any video is decoded."""
        folder = Path(recording.frames)
        poses = inputs.trajectory_files(recording.trajectory, _path(recording.keyframes))
        with naming_recording(name):
            pieces = inputs.read_trajectories(poses, _path(recording.timestamps), convention)
        files = {f"{name}: {what}": path for what, path in ({"frames": folder} | poses).items()}
        return cls(name, recording, files, tuple(pieces), folder)

    def scanned(self) -> FrameSet:
        """The frames in their folder."""
        one, given = self.recording, merging.choose(self.recording.masks).given
        timestamps, fps = (None, None) if self.extracted else (_path(one.timestamps), one.fps)
        calibration = _path(one.calibration)
        with naming_recording(self.name):
            circles = inputs.given_circles(one.circles, calibration)
            by_order = not self.trajectories
            return scan(self.folder, timestamps, fps, given, by_order, calibration, circles)

    def camera(self, settings: RefineSettings) -> CameraSettings:
        """Settings of its camera: the model that it names, the baseline of its calibration."""
        if self.recording.camera is not None:
            own = settings.camera.model_dump() | {"name": self.recording.camera}
            settings = validated(settings.model_dump() | {"camera": own})
        return inputs.with_baseline(settings, _path(self.recording.calibration)).camera

    def evidence(
        self, frames: FrameSet, settings: RefineSettings, plain: RefineSettings
    ) -> RecordingEvidence:
        """Initial poses of its frames, its gyro, and its camera by the `plain` settings of all."""
        with naming_recording(self.name):
            trajectories = tuple(inputs.timed(self.trajectories, frames))
            coarse = inputs.coarse_poses(frames, trajectories, settings)
            imu = inputs.read_gyro(_path(self.recording.imu), Path(self.recording.frames))
        start = RunStart.TRAJECTORY if trajectories else RunStart.PAIRS
        start, camera = RunStart.ODOMETRY if self.followed else start, self.camera(plain)
        return RecordingEvidence(self.name, coarse, trajectories, imu, camera, start)


def _path(given: Path | str | None) -> Path | None:
    return None if given is None else Path(given)


def _with_camera(settings: RefineSettings, given: Sequence[_Given]) -> RefineSettings:
    """Settings with the first camera model that is named, and the baseline of a calibration."""
    for name in [one.recording.camera for one in given if one.recording.camera is not None][:1]:
        camera = settings.camera.model_dump() | {"name": name}
        settings = validated(settings.model_dump() | {"camera": camera})
    for one in given:
        settings = inputs.with_baseline(settings, _path(one.recording.calibration))
    return settings


def _with_videos(
    given: Sequence[_Given],
    out: Path,
    origin: dict[str, Path],
    settings: RefineSettings,
    fresh: bool,
) -> tuple[list[_Given], bool, dict[str, StageRecord]]:
    """Recordings with the frames of videos extracted, whether to forget an earlier run yet, and
    the stages that extracted them."""
    if not any(video.is_video(one.folder) for one in given):
        return list(given), fresh, {}
    inputs.check_positions(settings)
    ready = []
    with RunStore(out, origin, fresh, title_of=title_of) as store:
        for one in given:
            ready.append(_extracted(one, store, settings) if video.is_video(one.folder) else one)
    return ready, False, store.records


def _extracted(one: _Given, store: RunStore, settings: RefineSettings) -> _Given:
    """A recording with its video's frames extracted, and followed where it has no trajectory."""
    recording = one.recording
    followed = inputs.follows(settings.video, recording.fps, recording.odometry, one.trajectories)
    chosen = merging.choose(recording.masks) if followed else None
    given = one.folder, settings, recording.fps, chosen, _path(recording.calibration), one.name
    with naming_recording(one.name):
        walk = inputs.extract_video(store, *given)
    ready = replace(one, folder=store.root / "frames" / one.name, extracted=True)
    if walk is None:
        return ready
    return replace(ready, trajectories=tuple(walk.pieces()), followed=True)
