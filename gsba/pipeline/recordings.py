"""Recordings as a caller gives them, one or several: their files, read, and frames of videos."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsba import video
from gsba.config import CameraSettings, RefineSettings
from gsba.config_file import validated
from gsba.frames.image_circles import given_circles
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks import merging
from gsba.odometry import Odometry
from gsba.pipeline import inputs
from gsba.pipeline.each_recording import naming_recording
from gsba.pipeline.run import RecordingEvidence
from gsba.pipeline.stage_titles import title_of
from gsba.store.store import RunStore, StageRecord
from gsba.trajectory.conventions import Convention
from gsba.trajectory.metashape import NamedPoses
from gsba.types import FrameSet, RunStart, Trajectory


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


@dataclass(frozen=True, slots=True)
class GivenRecording:
    """A recording with its name, its files, and what was read of them."""

    name: str  # "" = the only one
    recording: Recording
    files: dict[str, Path]  # inputs of the run by what they are
    trajectories: tuple[Trajectory | NamedPoses, ...]  # in pieces, each with its own world
    folder: Path  # of its frames, or its video
    extracted: bool = False  # True if its frames were extracted from a video
    walk: Odometry | None = None  # of its own images, which gave the trajectory

    @classmethod
    def of(cls, recording: Recording, name: str, convention: Convention) -> "GivenRecording":
        """A recording whose trajectory files are read, before any video is decoded."""
        folder, prefix = Path(recording.frames), f"{name}: " if name else ""
        with naming_recording(name):
            poses = inputs.trajectory_files(recording.trajectory, _path(recording.keyframes))
            origin = {"frames": folder} | poses
            pieces = inputs.read_trajectories(origin, _path(recording.timestamps), convention)
        files = {f"{prefix}{what}": path for what, path in origin.items()}
        return cls(name, recording, files, tuple(pieces), folder)

    def scanned(self) -> FrameSet:
        """The frames in their folder."""
        one, given = self.recording, merging.choose(self.recording.masks).given
        timestamps, fps = (None, None) if self.extracted else (_path(one.timestamps), one.fps)
        calibration = _path(one.calibration)
        with naming_recording(self.name):
            circles = given_circles(one.circles, calibration)
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
        start, camera = start if self.walk is None else RunStart.ODOMETRY, self.camera(plain)
        return RecordingEvidence(self.name, coarse, trajectories, imu, camera, start)


def _path(given: Path | str | None) -> Path | None:
    return None if given is None else Path(given)


def with_camera(settings: RefineSettings, given: Sequence[GivenRecording]) -> RefineSettings:
    """Settings with the first camera model that is named, and the baseline of a calibration."""
    for name in [one.recording.camera for one in given if one.recording.camera is not None][:1]:
        camera = settings.camera.model_dump() | {"name": name}
        settings = validated(settings.model_dump() | {"camera": camera})
    for one in given:
        settings = inputs.with_baseline(settings, _path(one.recording.calibration))
    return settings


def with_videos(
    given: Sequence[GivenRecording],
    out: Path,
    origin: dict[str, Path],
    settings: RefineSettings,
    fresh: bool,
) -> tuple[list[GivenRecording], bool, dict[str, StageRecord]]:
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


def _extracted(one: GivenRecording, store: RunStore, settings: RefineSettings) -> GivenRecording:
    """A recording with its video's frames extracted, and followed where it has no trajectory."""
    recording = one.recording
    followed = inputs.follows(settings.video, recording.fps, recording.odometry, one.trajectories)
    chosen = merging.choose(recording.masks) if followed else None
    calibration = _path(recording.calibration)
    with naming_recording(one.name):
        circles = given_circles(recording.circles, calibration)
        lenses = calibration, circles, one.name
        walk = inputs.extract_video(store, one.folder, settings, recording.fps, chosen, *lenses)
    ready = replace(one, folder=store.root / "frames" / one.name, extracted=True)
    if walk is None:
        return ready
    return replace(ready, trajectories=tuple(walk.pieces()), walk=walk)
