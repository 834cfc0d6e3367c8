"""What a run leaves behind: poses, cloud, datasets and the report."""

import json
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.bundle.families import Family, MapSnapshot
from gsba.bundle.gps_factors import GpsFactors
from gsba.bundle.map_strength import MAX_SCALE_SIGMA
from gsba.bundle.reconstruction import world_scale
from gsba.bundle.trajectory_prior import GyroTurns
from gsba.camera.calibration import calibration_json
from gsba.camera.cameras import Cameras
from gsba.config_file import to_toml
from gsba.disk import write_json, write_text
from gsba.export import ExportFormat, ExportOptions, export_all, seen_by, write_points
from gsba.export.folder import datasets_of_other_maps
from gsba.frames.recordings import names_of_cameras, own_timestamps
from gsba.log import GsbaError
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.pipeline.stage_titles import title_of
from gsba.pipeline.state import State
from gsba.placement.placement import Placement, metres_per_unit, place
from gsba.report import findings
from gsba.report.camera_findings import of_camera, of_lenses
from gsba.report.findings import notes_on_gps, notes_on_recordings, of_gyro, of_recordings
from gsba.report.html import residual_sphere, write_html
from gsba.report.maps import MapSummary, is_partial, summarize_maps
from gsba.report.report import Findings, StageLog, build_report, plain, write_poses
from gsba.report.verdict import Level
from gsba.store.finished import map_digest, one_map
from gsba.store.store import RunStore
from gsba.trajectory.files import write_tum
from gsba.types import CoarsePoses, Counts, FrameSet, Reconstruction, RunStart, Trajectory

logger = logging.getLogger(__name__)

CALIBRATION = "calibration.json"
TRAJECTORIES = "trajectories"  # folder of a trajectory file for each of several recordings
_OUTPUTS = (
    "trajectory.tum",
    "coarse.tum",
    "poses.csv",
    "points.ply",
    "transform.json",
    "config.toml",
    "report.json",
    "report.html",
)


@dataclass(frozen=True, slots=True)
class RunResult:
    """What `refine` leaves in memory; the rest is in the run's folder."""

    out: Path
    frames: FrameSet
    coarse: CoarsePoses  # before
    reconstruction: Reconstruction  # after
    report: dict[str, Any]  # the content of report.json
    maps: tuple[MapSummary, ...]  # of the reconstruction, the largest first: it is exported

    @property
    def partial(self) -> bool:
        """Whether less than nine tenths of the frames are in the map that is exported."""
        return is_partial(self.maps, len(self.frames) + self.report["summary"]["frames_unusable"])

    @property
    def failed(self) -> bool:
        """True if the run is partial, or its map is not good to train on."""
        return self.partial or self.report["verdict"]["level"] == Level.REFUSED


def write(state: State, result: Reconstruction, cameras: Cameras) -> RunResult:
    """Poses, cloud, report and datasets; of several maps that nothing ties together the largest."""
    run, prior, world = state.run, state.prior, state.map
    store, settings, coarse = run.store, run.settings, prior.coarse
    frames, out, rows = world.straightened(run.frames), store.root, result.largest_map()
    main, shown = result.of_map(1), frames.taken(rows)
    write_tum(out / "trajectory.tum", Trajectory(shown.timestamps, main.world_T_rigs))
    start = coarse.taken(rows)
    (out / "coarse.tum").unlink(missing_ok=True)
    if not prior.absent:
        write_tum(out / "coarse.tum", Trajectory(shown.timestamps, start.world_T_rigs))
    _write_trajectories(store, shown, main)
    start_name = run.evidence.start_name(prior.absent)
    write_poses(out / "poses.csv", frames, coarse, result, start_name)
    write_points(out / "points.ply", main)
    (out / "transform.json").unlink(missing_ok=True)
    if main.origin is not None:
        Placement().of_trajectory(main.origin).write(out / "transform.json")
    write_text(out / "config.toml", to_toml(settings))
    (out / CALIBRATION).unlink(missing_ok=True)
    _write_calibrations(state, result, cameras)
    baseline = settings.camera.baseline()
    placement = place(main, shown, settings.placement, baseline, settings.gps, frames)
    _export(run, main, shown, placement, cameras.taken(rows))
    _warn_of_datasets_before(out, result, frames)
    report = _report(state, result)
    write_json(out / "report.json", report)
    page = report | {"frames": [report["frames"][f] for f in rows]}
    write_html(out / "report.html", shown, start, main, page, cameras.taken(rows))
    for name in (*_OUTPUTS, CALIBRATION):
        store.claim(out / name)
    maps = summarize_maps(result, frames, _reasons(prior))
    return RunResult(out, frames, coarse, result, report, maps)


def _write_trajectories(store: RunStore, shown: FrameSet, main: Reconstruction) -> None:
    """A trajectory file for each of several recordings, on its own clock."""
    folder, times = store.root / TRAJECTORIES, own_timestamps(shown)
    for path in folder.glob("*.tum"):  # of an earlier call
        path.unlink()
    for name, rows in shown.recordings.items():
        folder.mkdir(exist_ok=True)
        write_tum(folder / f"{name}.tum", Trajectory(times[rows], main.world_T_rigs[rows]))
        store.claim(folder / f"{name}.tum")


def _reasons(prior: Prior) -> tuple[str, ...]:
    return () if prior.merged is None else prior.merged.reasons


def _write_calibrations(state: State, result: Reconstruction, cameras: Cameras) -> None:
    """Raw lenses as found, for other runs: calibration.json, or of several cameras one for each."""
    frames, store = state.map.straightened(state.run.frames), state.run.store
    for path in store.root.glob(f"calibration@*{CALIBRATION[-5:]}"):  # of an earlier call
        path.unlink()
    several = len(frames.formats) > 1
    baseline, metres = state.run.settings.camera.baseline(), None
    apart = result.lens_baseline
    if baseline is not None and apart is not None and np.isfinite(apart[1]):
        metres = metres_per_unit(apart, baseline)[0]
    for number, name in enumerate(names_of_cameras(frames)):
        rig = frames.formats[number].fisheyes
        if rig is not None:
            path = store.root / (f"calibration@{name}.json" if several else CALIBRATION)
            read, centre = state.map.cameras[number].estimate(), cameras.lenses[number].centre
            timed = read.lenses.readout_motion is not None
            more = {"readout_s": read.readout_s} if timed else {}
            scale, unit = (1.0, "map") if metres is None else (metres, "m")
            write_json(path, calibration_json(rig, centre * scale, unit, more))
            store.claim(path)


def of_family(family: Family, snapshot: MapSnapshot) -> Any:
    """Part of a family in the report. GsbaError: JSON cannot hold it."""
    found = plain(family.report(snapshot))
    try:
        json.dumps(found)
    except (TypeError, ValueError) as error:
        raise GsbaError(
            f"family {family.name}: report.json cannot hold what its report() returns ({error}): "
            "return numbers, texts, lists and dictionaries"
        ) from None
    return found


def _report(state: State, result: Reconstruction) -> dict[str, Any]:
    run, rounds = state.run, state.run.journal.rounds
    solver = [{"stage": name, "rounds": some} for name, some in rounds.items()]
    costs, again_s = tuple(run.store.records.values()), run.store.seconds_again
    stages = StageLog(costs, run.journal.counts, solver, again_s)
    snapshot = run.families.snapshot(state.solution, state.prior.parts)
    of_families = {family.name: of_family(family, snapshot) for family in run.families.members}
    of_families = {name: report for name, report in of_families.items() if report}
    gauge = _gauge(run, state.prior)
    found = _findings(state, result, of_families.pop(GpsFactors.name, None))
    coarse = state.prior.coarse
    report = build_report(run.settings, run.frames, coarse, result, stages, gauge, found)
    report["families"] = of_families
    report["stages"] = [one | {"title": title_of(one["name"])} for one in report["stages"]]
    if len(run.frames.formats) > 1:
        frames = state.run.frames
        every = list[dict[str, Any]]()
        for number, kind in enumerate(frames.formats):
            rows = frames.recordings.items()
            recordings = [name for name, own in rows if frames.cameras[own[0]] == number]
            content = {"recordings": recordings, "layout": kind.layout}
            content |= {"width": kind.width, "height": kind.height}
            every.append(content | {"lenses": plain(_of_camera(state, result, number)[0])})
        report["cameras"] = every
    report["residual_sphere"] = plain(residual_sphere(result), digits=4)
    return report


def _warn_of_datasets_before(out: Path, result: Reconstruction, frames: FrameSet) -> None:
    """Warn of datasets in the run's folder that hold a map of an earlier call."""
    maps = range(1, result.num_maps + 1)
    digests = {map_digest(*one_map(result, frames, number, str(out))) for number in maps}
    for name, to in datasets_of_other_maps(out, digests).items():
        logger.warning(
            "%s holds a map of an earlier call: write it anew (gsba export %s --to %s --out %s), "
            "or delete it",
            out / name,
            out,
            to,
            out / name,
        )


def _findings(state: State, result: Reconstruction, gps: dict[str, Any] | None) -> Findings:
    """Sections of the report on trajectory, camera and sensors, and notes on all that is odd."""
    prior, map_, frames, given = state.prior, state.map, state.run.frames, state.run.evidence
    trajectory, notes = findings.of_trajectory(
        prior.trust, prior.clock, prior.merged, prior.joints, frames, prior.unguided
    )
    camera, more = None, list[str]()
    if len(map_.cameras) == 1:
        camera, more = _of_camera(state, result, 0)
    else:
        for number, name in enumerate(names_of_cameras(frames)):
            _, found_of_one = _of_camera(state, result, number)
            more += [f"camera of {name}: {note}" for note in found_of_one]
    notes += more
    gyro = None
    if prior.gyro is not None:
        used, snapshot = None, state.run.families.snapshot(state.solution, prior.parts)
        for family in prior.families(state.run.settings.priors):
            if isinstance(family, GyroTurns):
                used = family.report(snapshot)["steps_used"]
        gyro, more = of_gyro(prior.gyro, used, map_.cameras[0].readout)
        notes += more
    if gps is not None:
        notes += notes_on_gps(gps, len(frames))
    start = state.run.evidence.start_name(prior.absent)
    found_of = frames, prior.coarse, result, map_.frame_weights, MAX_SCALE_SIGMA, start
    lists, more = findings.of_frames(*found_of)
    notes += more
    stitching = map_.stitching and findings.of_field(map_.stitching)
    clocks, sources = [one.clock for one in prior.of_recordings], prior.coarse.sources
    recordings = of_recordings(frames, result, sources, clocks)
    notes += notes_on_recordings(recordings)
    found = Findings(notes, trajectory, stitching, camera, gyro, gps, map_.moves)
    return replace(
        found,
        recordings=recordings,
        reasons=_reasons(prior),
        frame_lists={**lists, "unusable": list(given.unusable)},
        start=start,
        order_doubted=prior.order_doubted,
        lone_steps=prior.lone_steps,
    )


def _of_camera(
    state: State, result: Reconstruction, number: int
) -> tuple[dict[str, Any] | None, list[str]]:
    """Section of the report on one camera, None = its lenses were not looked for, and notes."""
    run, map_ = state.run, state.map
    found, kind = map_.cameras[number], run.frames.formats[number]
    if found.centres is None:
        return None, []
    known = None if map_.covariances is None else map_.covariances.cameras[number]
    scale = world_scale(state.solution, result)
    content, notes = of_camera(found, known, scale, run.settings_of(number), run.is_timed(number))
    if kind.fisheyes is not None:
        content["lenses"], of_raw = of_lenses(found, known)
        notes += of_raw
    return content, notes


def _gauge(run: Run, prior: Prior) -> str:
    """A sentence on what defines world and scale, and on the gauge of covariances."""
    fixing = run.families.fixing_gauge.members
    if fixing:
        names = ", ".join(family.name for family in fixing)
        world = f"families {names} fix the world or the scale"
    elif run.evidence.start == RunStart.EARLIER_RUN:
        world = "the world and scale of the run that it started from, of several the first"
    elif prior.absent:
        world = (
            "no trajectory: the first frame's axes, and the median step of the start as the unit"
        )
    elif prior.of_recordings:
        first = "the first recording that has one"
        world = f"Sim(3)-aligned to the trajectory of {first}: its world and scale"
    else:
        world = "Sim(3)-aligned to the initial poses of refined frames: their world and scale"
    held = "the first pose and the distance to the frame furthest from it"
    return f"{world}; covariances hold {held}"


def _export(
    run: Run, main: Reconstruction, shown: FrameSet, placement: Placement, cameras: Cameras
) -> None:
    """Datasets in all formats; the first that is not there yet has the others written with it."""
    store, size, images = run.store, run.settings.export.face_size, run.settings.export.images
    fetched = run.settings.export.fetched
    shown_by = seen_by(images, shown, cameras)
    key = [size, placement.to_json(), images, bool(shown_by), fetched]
    folders = {ExportFormat(name): store.root / name for name in run.settings.export.formats}
    waiting = {}
    for to, folder in folders.items():
        if not folder.exists():
            store.forget(f"export-{to.value}")
        if store.stored(f"export-{to.value}", key, Counts, run.latest) is None:
            waiting[to] = folder

    def compute() -> Counts:
        if waiting:
            options = ExportOptions(
                size, placement, lenses=shown_by, images=images, fetched=fetched
            )
            export_all(main, shown, waiting, options, store.workers)
            waiting.clear()
        apart = len(run.frames) - len(shown)
        dropped = {"in another map or in none": apart} if apart else {}
        left_out = 0 if fetched else len(shown) - len(shown.chosen())
        dropped |= {"fetched for the map alone": left_out} if left_out else {}
        return Counts(len(run.frames), len(shown) - left_out, "frames", dropped)

    for to, folder in folders.items():
        store.stage(f"export-{to.value}", key, compute, Counts, run.latest)
        store.claim(folder)
