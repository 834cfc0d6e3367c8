"""Cameras of several runs: which are one (of one mode and calibration, without two model names),
and the estimate of each by the run that knows most of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.readout import CameraEstimate, velocities
from gsba.camera.lens import ONE_CENTRE, Lenses
from gsba.config import CameraSettings
from gsba.frames.recordings import one_mode
from gsba.log import GsbaError
from gsba.pipeline.finished_run import FinishedRun
from gsba.similarity import Sim3
from gsba.types import FrameSet, PictureFormat, Solution

_UNKNOWN_MODEL = {"name": None, "baseline_mm": None, "readout_ms": None}  # changes of settings


@dataclass(frozen=True, slots=True)
class JointCameras:
    """Cameras of several runs, those that are one counted once."""

    formats: tuple[PictureFormat, ...]  # (C,)
    settings: tuple[CameraSettings, ...]  # (C,)
    numbers: tuple[tuple[int, ...], ...]  # for each run, number here of each of its cameras
    seen_by: tuple[int, ...]  # (C,) run whose estimate of each camera is taken

    @classmethod
    def of(cls, runs: Sequence[FinishedRun]) -> "JointCameras":
        """Tell which cameras of runs are one."""
        formats, settings, numbers = list[PictureFormat](), list[CameraSettings](), []
        for run in runs:
            own = list[int]()
            for kind, chosen in zip(run.frames.formats, run.camera_settings, strict=True):
                known = zip(formats, settings, strict=True)
                alike = [
                    c
                    for c, (one, other) in enumerate(known)
                    if c not in own
                    and one_mode(one, kind)
                    and one.fisheyes == kind.fisheyes  # one calibration has read both
                    and _one_model(other, chosen)
                ]
                if len(alike) != 1:  # none, or nothing tells which
                    alike = [len(formats)]
                    formats.append(kind)
                    settings.append(chosen)
                elif settings[alike[0]].name is None and chosen.name is not None:
                    settings[alike[0]] = chosen
                own.append(alike[0])
            numbers.append(tuple(own))
        seen_by = tuple(_best_run(runs, numbers, c) for c in range(len(formats)))
        return cls(tuple(formats), tuple(settings), tuple(numbers), seen_by)

    def of_frames(self, runs: Sequence[FinishedRun]) -> tuple[int, ...]:
        """Camera (F,) of all frames of the runs; () = there is one."""
        if len(self.formats) == 1:
            return ()
        pairs = zip(self.numbers, runs, strict=True)
        return tuple(own[c] for own, run in pairs for c in run.frames.cameras.tolist())

    def in_run(self, camera: int, run: int) -> int | None:
        """Number of a camera in a run; None = it took none of its frames."""
        own = self.numbers[run]
        return own.index(camera) if camera in own else None

    def shared(self, one: int, other: int) -> list[tuple[int, int]]:
        """Numbers that the cameras of both of two runs have in either."""
        first, second = self.numbers[one], self.numbers[other]
        return [(first.index(c), second.index(c)) for c in first if c in second]

    def found(
        self,
        runs: Sequence[FinishedRun],
        moves: Sequence[Sim3],
        solution: Solution,
        frames: FrameSet,
    ) -> tuple[FoundCamera, ...]:
        """Estimate of each camera (C,) for the frames of all runs, which `moves` place in the joint
        one."""
        times, poses = frames.timestamps, solution.world_T_rigs
        starts = np.cumsum([0, *(len(run.frames) for run in runs)])

        def estimate(camera: int, known: FoundCamera) -> CameraEstimate | None:
            """For the frames of all runs; None = one centre, not looked for."""
            if not known.lenses:
                return known.readout
            found = known.estimate()
            motion, axes = list[np.ndarray](), list[np.ndarray]()
            for n, (run, move) in enumerate(zip(runs, moves, strict=True)):
                rows, c = np.arange(starts[n], starts[n + 1]), self.in_run(camera, n)
                lenses = ONE_CENTRE if c is None else run.map.cameras[c].lenses
                if found.lenses.readout_motion is not None:
                    moved = None if c is None else lenses.scaled(move.scale).readout_motion
                    if moved is None:  # the run did not find it
                        maps = run.result.components
                        rates = velocities(poses[rows], times[rows], maps=maps)
                        moved = found.readout_s * rates
                    motion.append(moved)
                straight = np.tile(np.eye(3), (len(rows), 1, 1))
                axes.append(straight if lenses.axes is None else lenses.axes)
            lenses = found.lenses
            if lenses.readout_motion is not None:
                lenses = replace(lenses, readout_motion=np.concatenate(motion))
            if lenses.axes is not None:
                lenses = replace(lenses, axes=np.concatenate(axes))
            return replace(found, lenses=lenses)

        every = list[FoundCamera]()
        for camera, number in enumerate(self.seen_by):
            inside = self.in_run(camera, number)
            assert inside is not None
            known = runs[number].map.cameras[inside].scaled(moves[number].scale)
            found, centres = estimate(camera, known), known.centres
            if centres is not None:
                centres = replace(centres, lenses=Lenses() if found is None else found.lenses)
            every.append(replace(known, centres=centres, readout=found))
        return tuple(every)


def as_read_by(
    run: FinishedRun, found: Mapping[str, FrameSet], models: Mapping[str, str | None]
) -> dict[str, tuple[FrameSet, CameraSettings]]:
    """New recordings as a run reads pictures of its cameras, and the settings of their cameras.

    Raw fisheyes without a calibration are read by that of the run, which is better known than what
    image circles tell. Settings of a camera that the run does not have say nothing of its model.

    Args:
        found: frames of the recordings by their names, of one camera each.
        models: camera model by recording; None = not known.

    Raises:
        GsbaError: a recording has a camera of its own, and the run a field of stitching errors.
    """
    read = dict[str, tuple[FrameSet, CameraSettings]]()
    for name, frames in found.items():
        model = run.settings.camera.model_copy(update={"name": models[name]})
        known = zip(run.frames.formats, run.camera_settings, strict=True)
        alike = [
            (kind, own) for kind, own in known if _one_make(kind, frames) and _one_model(own, model)
        ]
        if len(alike) != 1:
            refuse_fields([run], several=True)
            metric = isinstance(run.settings.camera.stitch_radius_m, float)
            changes = _UNKNOWN_MODEL | ({"stitch_radius_m": None} if metric else {})
            read[name] = frames, run.settings.camera.model_copy(update=changes)
            continue
        kind, settings = alike[0]
        if frames.format.lenses_nominal:
            frames = frames.with_formats([replace(kind, lenses_nominal=False)])
        read[name] = frames, settings
    return read


def refuse_fields(runs: Sequence[FinishedRun], several: bool) -> None:
    """Refuse to lay cameras beside one for which a field of stitching errors was found, if runs are
    to be one of `several` cameras."""
    for run in runs if several else ():
        if run.map.field:
            raise GsbaError(
                f"{run.root} corrects errors of stitching by a field ([stitching]), which is known "
                "for one camera only, and there are several here: refine all recordings together "
                "(gsba refine A B --out RUN)"
            )


def _one_make(kind: PictureFormat, frames: FrameSet) -> bool:
    """True if a camera with such pictures can have made frames, whatever is known of its lenses."""
    own = frames.format
    if not own.lenses_nominal:
        return one_mode(kind, own)
    sizes = [[(one.width, one.height) for one in each.fisheyes or ()] for each in (kind, own)]
    unmasked = all(path is None for path in frames.mask_paths)  # masks have the panorama's size
    return sizes[0] == sizes[1] and (unmasked or kind.width == own.width)


def _one_model(one: CameraSettings, other: CameraSettings) -> bool:
    """True unless settings name two models."""
    return one.name is None or other.name is None or one.name == other.name


def _best_run(runs: Sequence[FinishedRun], numbers: Sequence[tuple[int, ...]], camera: int) -> int:
    """The run that knows most of a camera; of several the first one."""
    having = [n for n, own in enumerate(numbers) if camera in own]
    lenses = [runs[n].map.cameras[numbers[n].index(camera)].lenses for n in having]
    known = [(bool(one), sum(one.parts)) for one in lenses]
    return having[known.index(max(known))]
