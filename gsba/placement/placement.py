"""Placement of an exported world: upright, metric, by GPS, by true poses or by a scan."""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np

from gsba.bundle.gps_factors import MAX_DRIFT_SHARE, FrameFixes
from gsba.config import GpsSettings, PlacementSettings
from gsba.geometry import extent_of
from gsba.log import GsbaError, brief
from gsba.placement.frame_fixes import fixes_of_frames, read_fixes
from gsba.placement.gps_fit import GpsFit, fit_fixes
from gsba.placement.gps_shape import are_mirrored, lag_of, positions_at
from gsba.placement.world import Placement
from gsba.scans.files import check_scan, normals_of, read_pairs, read_scan, upwards
from gsba.scans.registration import in_file, register
from gsba.scans.search import Guess
from gsba.scans.types import Scan, cloud_of
from gsba.similarity import (
    Sim3,
    extents,
    is_mirrored,
    naming,
    pose_similarity,
    residuals_of,
    robust_similarity,
    similarity,
)
from gsba.trajectory.association import matched_in_time
from gsba.trajectory.files import MAX_COORDINATE, read_trajectory
from gsba.types import FrameSet, PoseStatus, Reconstruction, Trajectory

logger = logging.getLogger(__name__)

_UP_WORLD = np.array([0.0, -1.0, 0.0])  # up of an upright world, whose y points down
_TOLERANCE_S = 0.02  # largest time from a frame to its true pose
_MAX_LENS_SCALE_SIGMA = 0.1  # relative, of a scale by the lenses
_MAX_GPS_ANGLE_SIGMA_DEG = 25.0  # of heading and tilt by GPS
_MAX_SCALE_SIGMAS = 4.0  # of two scales that agree: true ones differ by more once in 16,000 runs
_MEASURED_SIGMA = 0.02  # relative, of a scale by a tape measure
_GUESS_SIGMAS = 3.0  # width of a guess in a scan, by GPS
_MAX_GUESS_ANGLE_DEG = 90.0  # wider guesses of an axis rule next to nothing out
_NUM_NAMED = 5  # false positions that a message names
_UPSIDE_DOWN = -0.5  # vertical component of the cameras' up axes: 120 degrees from up
_MAX_LEAN_DEG = 30.0  # from up, of the cameras' mean up axis: people hold them upright
_MIN_EXTENT_RATIO = 0.02  # of a path's second extent to its first: less determines no roll


def place(
    reconstruction: Reconstruction,
    frames: FrameSet,
    settings: PlacementSettings,
    baseline: tuple[float, float] | None = None,
    gps: GpsSettings | None = None,
    whole: FrameSet | None = None,
) -> Placement:
    """Placement of a run's world by the settings.

    Args:
        frames: its frames; their images are read to find the vertical.
        settings: `up` alone applies the smallest rotation that makes -y point up. With `length`
            the unit becomes the metre. `gps` gives metres east, north and up; together with `up` it
            determines heading, scale and translation only; with a length of "lens" the scale is
            the weighted mean of both; "exif" uses the positions in the images. `align` gives the
            world of true poses, `scan` that of a scan of the place; with a scan, `up`, `gps` or
            `pairs` only start the alignment.
        baseline: distance of the lenses and its standard deviation, metres, for a length of "lens";
            other scales that contradict it are warned of.
        gps, whole: as of `fixes_of_frames`.

    Raises:
        GsbaError: settings exclude one another, or data do not determine the placement.
    """
    check(settings, baseline=baseline)
    placement = _placement(reconstruction, frames, settings, baseline, gps, whole)
    if placement.unit == "m" and settings.length != "lens":
        _warn_of_lenses(placement, reconstruction, baseline)
    placed = placement.similarity.points(reconstruction.world_T_rigs[:, :3, 3])
    far = np.abs(placed).max(initial=0)
    scale = placement.similarity.scale
    if not (1 / MAX_COORDINATE <= scale <= MAX_COORDINATE and far <= MAX_COORDINATE):
        raise GsbaError(
            f"the placed run would have a scale of {scale:g} and coordinates up to {far:g}: check "
            "the values of --scale, --between, --gps, --align or --align-scan"
        )
    if settings.gps is None and settings.align is None and settings.scan is None:
        return placement.of_trajectory(reconstruction.origin)
    return placement.near_origin(placed)


def _placement(
    reconstruction: Reconstruction,
    frames: FrameSet,
    settings: PlacementSettings,
    baseline: tuple[float, float] | None,
    gps: GpsSettings | None,
    whole: FrameSet | None,
) -> Placement:
    """Placement by the settings, without a check of its range."""
    if settings.align is not None:
        return _aligned(reconstruction, frames, Path(settings.align))
    if settings.scan is not None:
        path = Path(settings.scan)
        scan = read_scan(path)
        guess, grounds = guess_in_scan(reconstruction, frames, settings, scan, gps, whole)
        with in_file(path):
            found = register(cloud_of(reconstruction, normals_of), scan, guess)
        logger.info("--align-scan %s: %s", path, found)
        grounds |= {"scan": {"file": str(path), **found.to_json()}}
        up = upwards(path) if settings.up == "auto" else None
        unit = "units of the scan"
        return Placement(found.fit.similarity, unit, up, scan.offset, grounds=grounds)
    placement = Placement()
    if settings.up == "auto":
        placement = _upright(reconstruction, frames)
    if settings.gps is not None:
        scale = None
        if settings.length == "lens":
            scale, grounds = _scale_by_lenses(reconstruction, baseline)
            grounds = {**placement.grounds, "lens": grounds}
            placement = dataclasses.replace(placement, grounds=grounds)
        fixes = fixes_of_frames(settings.gps, frames, gps, whole)
        return _on_earth(reconstruction, frames, Path(settings.gps), fixes, placement, scale)
    if settings.length == "lens":
        (scale, sigma), grounds = _scale_by_lenses(reconstruction, baseline)
        if not sigma < _MAX_LENS_SCALE_SIGMA * scale:
            raise GsbaError(
                "--scale lens: the scale by the distance between the lenses has a sigma of "
                f"{100 * sigma / scale:.0f} %; less than {100 * _MAX_LENS_SCALE_SIGMA:.0f} % is "
                "needed: scale it by --scale LENGTH --between A B"
            )
        return dataclasses.replace(
            placement,
            similarity=dataclasses.replace(placement.similarity, scale=scale),
            unit="m",
            grounds={**placement.grounds, "lens": grounds},
        )
    if settings.length is not None and settings.between is not None:
        first, second = (_point(end, reconstruction, frames) for end in settings.between)
        distance = float(np.linalg.norm(second - first))
        if distance <= 1e-9 * (1 + np.abs(first).max()):
            raise GsbaError(f"--between {' '.join(settings.between)}: both ends are at one point")
        scaled = dataclasses.replace(placement.similarity, scale=settings.length / distance)
        grounds = {**placement.grounds, "length": settings.length, "between": settings.between}
        placement = dataclasses.replace(placement, similarity=scaled, unit="m", grounds=grounds)
    return placement


def check(
    settings: PlacementSettings,
    frames: FrameSet | None = None,
    baseline: tuple[float, float] | None = None,
) -> None:
    """Check settings, and the files that they name (positions in images only of known `frames`),
    with the distance of the lenses and its sigma, metres. GsbaError if any exclude one another."""
    if settings.length == "lens" and baseline is None:
        raise GsbaError(
            "--scale lens needs the distance between the lenses: refine with --camera NAME or "
            "--set camera.baseline_mm=MM, or export with --baseline MM (an Insta360 X5 has 32)"
        )
    if isinstance(settings.length, float) != (settings.between is not None):
        raise GsbaError("--scale LENGTH and --between A B need each other: pass both")
    measured = isinstance(settings.length, float)  # a scale by the lenses combines with GPS
    ways = [measured, settings.gps is not None, settings.align is not None]
    if sum(ways) > 1 or (settings.length is not None and settings.align is not None):
        raise GsbaError(
            "--scale, --gps and --align each set the scale: pass one, or --scale lens with --gps"
        )
    if settings.scan is not None and (settings.length is not None or settings.align is not None):
        raise GsbaError("--align-scan sets the scale: leave out --scale and --align")
    if settings.pairs is not None and settings.scan is None:
        raise GsbaError("--pairs needs a scan: give --align-scan SCAN as well")
    if settings.align is not None and settings.up != "none":
        raise GsbaError("--align sets the rotation of the world: leave out --up auto")
    if settings.gps is not None:
        read_fixes(settings.gps, frames)
    if settings.align is not None:
        read_trajectory(Path(settings.align))
    if settings.scan is not None:
        check_scan(Path(settings.scan))
    if settings.pairs is not None:
        read_pairs(Path(settings.pairs))


def _upright(reconstruction: Reconstruction, frames: FrameSet) -> Placement:
    from gsba.placement.gravity import degrees_off, estimate_gravity

    gravity = estimate_gravity(reconstruction, frames)
    if gravity is None:
        raise GsbaError(
            "--up auto: the frames have no common up axis; leave it out, or give --gps FILE"
        )
    grounds = {
        "vertical_edges": gravity.num_edges,
        "edges_to_rigs_deg": round(gravity.turn_deg, 4),
        "rigs_spread_deg": round(gravity.spread_deg, 4),
    }
    for name, up in (("accelerometer", gravity.by_forces), ("tags", gravity.by_tags)):
        if up is not None:
            grounds[f"edges_to_{name}_deg"] = round(degrees_off(gravity.up, up), 4)
    rotation = _least_turn(gravity.up, _UP_WORLD)
    return Placement(Sim3(rotation=rotation), up="-y", grounds={"gravity": grounds})


def metres_per_unit(
    lenses: tuple[float, float], baseline: tuple[float, float]
) -> tuple[float, float]:
    """Metric scale and its standard deviation, from the distance of two lenses (map units) and its
    published value (metres), each with its standard deviation."""
    scale = baseline[0] / lenses[0]
    return scale, scale * float(np.hypot(lenses[1] / lenses[0], baseline[1] / baseline[0]))


def _scale_by_lenses(
    reconstruction: Reconstruction, baseline: tuple[float, float] | None
) -> tuple[tuple[float, float], dict[str, Any]]:
    """Metric scale and its standard deviation by the lenses, and the entry of transform.json."""
    if reconstruction.lens_baseline is None:
        raise GsbaError(
            "--scale lens: the run found no two lenses (for the reason see camera in report.json): "
            "scale it by --scale LENGTH --between A B"
        )
    if not np.isfinite(reconstruction.lens_baseline[1]):
        raise GsbaError(
            "--scale lens: of the cameras whose lenses were found none has a known distance "
            "between them (see cameras in report.json): scale it by --scale LENGTH --between A B"
        )
    assert baseline is not None  # see check
    scale, sigma = metres_per_unit(reconstruction.lens_baseline, baseline)
    return (scale, sigma), {"baseline_m": baseline[0], "scale_sigma": sigma}


def _warn_of_lenses(
    placement: Placement, reconstruction: Reconstruction, baseline: tuple[float, float] | None
) -> None:
    """Warn of a metric scale that contradicts the distance between the lenses, if that is known."""
    if baseline is None or reconstruction.lens_baseline is None:
        return
    scale = placement.similarity.scale
    lens, sigma = metres_per_unit(reconstruction.lens_baseline, baseline)
    own = placement.grounds.get("gps", {}).get("scale_sigma", _MEASURED_SIGMA * scale) / scale
    if abs(np.log(scale / lens)) > _MAX_SCALE_SIGMAS * np.hypot(own, sigma / lens):
        logger.warning(
            "the run is placed with %.4g m to a map unit, but the distance between its lenses "
            "gives %.4g (sigma %.2g %%): check the length or positions that were given, and the "
            "camera",
            scale,
            lens,
            100 * sigma / lens,
        )


def _least_turn(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Smallest rotation (3, 3) that maps one unit vector to another."""
    axis, cosine = np.cross(source, target), float(source @ target)
    if cosine < -1 + 1e-12:  # opposite: half a turn around any perpendicular axis
        other = np.eye(3)[np.argmin(np.abs(source))]
        axis = np.cross(source, other)
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def _point(text: str, reconstruction: Reconstruction, frames: FrameSet) -> np.ndarray:
    """Position (3,), run's world, of a frame by name or of "x,y,z"."""
    if text in frames.names:
        f = frames.names.index(text)
        if reconstruction.pose_statuses[f] != PoseStatus.REFINED:
            raise GsbaError(
                f"--between {brief(text)}: its pose was not refined: choose another frame"
            )
        return reconstruction.world_T_rigs[f, :3, 3]
    try:
        point = np.array([float(part) for part in text.split(",")])
    except ValueError:
        point = np.zeros(0)
    if len(point) != 3 or not (np.abs(point) <= MAX_COORDINATE).all():
        raise GsbaError(
            f"--between {brief(text)}: this is neither a frame (such as {frames.names[0]}) nor a "
            "point x,y,z"
        )
    return point


def _on_earth(
    reconstruction: Reconstruction,
    frames: FrameSet,
    path: Path,
    fixes: FrameFixes,
    upright: Placement,
    scale: tuple[float, float] | None = None,
    determined: bool = True,
) -> Placement:
    """Placement in metres east, north and up around the median fix; keeps `upright`'s up. GsbaError
    if fixes contradict the run or, where it is to be `determined`, leave scale or axes open."""
    fixes = fixes.taken(reconstruction.pose_statuses[fixes.frames] == PoseStatus.REFINED)
    if len(fixes) < 3:
        raise GsbaError(
            f"{path}: {len(fixes)} of its positions are of refined frames; 3 are needed: check "
            "that they are of this recording and on the frames' clock"
        )
    positions, level, up_sigma = reconstruction.world_T_rigs[fixes.frames, :3, 3], np.eye(3), None
    if upright.up is not None:
        level = _least_turn(_UP_WORLD, np.array([0.0, 0, 1])) @ upright.similarity.rotation
        gravity, degrees = upright.grounds.get("gravity", {}), 3.0  # by the rigs' up axes
        if gravity.get("vertical_edges"):
            degrees = 0.2  # see docs/gyro.md
        elif "edges_to_accelerometer_deg" in gravity:
            degrees = 0.5  # for the accelerometer's bias
        up_sigma = float(np.radians(degrees))
    elif extents(positions)[1] <= _MIN_EXTENT_RATIO:
        raise GsbaError(
            f"{path}: the frames lie on a line, which determines no roll: add --up auto"
        )
    good = reconstruction.pose_statuses == PoseStatus.REFINED
    times, everywhere = frames.timestamps[good], reconstruction.world_T_rigs[good, :3, 3]
    lag = lag_of(fixes, times, everywhere @ level.T, level=up_sigma is not None)
    if lag:
        fixes, positions = _moved(path, fixes, lag, times, everywhere)
    if up_sigma is not None and are_mirrored(fixes, positions @ level.T):
        raise GsbaError(
            f"{path}: its positions fit the mirror image of the run better: in the file, latitude "
            "and longitude are swapped, or the sign of one of them is missing"
        )
    with naming(path):
        found = fit_fixes(positions @ level.T, fixes, up_sigma, scale)
    off = residuals_of(found.similarity, positions @ level.T, fixes.positions)
    _require_majority(
        path,
        found.used,
        off,
        frames,
        fixes.frames,
        "a noisier receiver needs --gps-sigma (of export)",
    )
    if determined:
        _require_determined(path, found, fixes)
    if scale is not None:
        alone = fit_fixes(positions @ level.T, fixes, up_sigma)
        ratio = abs(np.log(alone.similarity.scale / scale[0]))
        if ratio > _MAX_SCALE_SIGMAS * np.hypot(alone.scale_sigma, scale[1] / scale[0]):
            raise GsbaError(
                f"{path}: its positions give {alone.similarity.scale:.4g} m per map unit (sigma "
                f"{100 * alone.scale_sigma:.2g} %), the lenses {scale[0]:.4g} (sigma "
                f"{100 * scale[1] / scale[0]:.2g} %): check --baseline and the positions, and pass "
                "one of --gps and --scale lens"
            )
    fit = dataclasses.replace(found.similarity, rotation=found.similarity.rotation @ level)
    ups = -reconstruction.world_T_rigs[fixes.frames, :3, 1] @ fit.rotation.T
    _warn_of_lean(path, ups, np.inf if up_sigma is not None else np.degrees(found.tilt_sigma))
    sigmas = found.position_sigmas(everywhere @ level.T)  # also where there are no fixes
    grounds = {
        **upright.grounds,
        "gps": {
            "file": str(path),
            "fixes": len(found.used),
            "outliers": int(np.sum(~found.used)),
            "rmse_m": found.rms_m,
            "misfit": found.misfit,
            "scale_sigma": found.scale_sigma * found.similarity.scale,
            "heading_sigma_deg": float(np.degrees(found.heading_sigma)),
            "tilt_sigma_deg": float(np.degrees(found.tilt_sigma)),
            "position_sigma_m": np.median(sigmas, axis=0).tolist(),  # east, north and up
            "largest_position_sigma_m": sigmas.max(axis=0).tolist(),
            "lag_s": lag,  # by which fixes are behind their frames
        },
    }
    logger.info(
        "--gps %s: %d of %d positions are inliers, with an RMS residual of %.3g m, at latitude "
        "%.5f, longitude %.5f; sigmas: scale %.2g %%, heading %.2g degrees, tilt %.2g degrees, "
        "position %.2g m, at most %.2g m",
        path,
        found.used.sum(),
        len(fixes),
        found.rms_m,
        *fixes.origin[:2],
        100 * found.scale_sigma,
        np.degrees(found.heading_sigma),
        np.degrees(found.tilt_sigma),
        np.median(sigmas[:, 0]),
        sigmas[:, 0].max(),
    )
    where = (float(fixes.origin[0]), float(fixes.origin[1]), float(fixes.origin[2]))
    return Placement(fit, unit="m", up="z", origin=where, grounds=grounds)


def _warn_of_lean(path: Path, ups: np.ndarray, tilt_sigma_deg: float) -> None:
    """Warn of cameras, by their placed up axes (G, 3), that hang head down, or that are alike and
    lean much more than the tilt is uncertain by: altitudes that jump or drift tilt a run."""
    if np.median(ups[:, 2]) < _UPSIDE_DOWN:
        logger.warning(
            "--gps %s: the placed run is upside down: in the file, latitude and longitude are "
            "swapped, or a direction is reversed, unless the camera hung head down; --up auto "
            "refuses such positions",
            path,
        )
        return
    held = ups.mean(axis=0)
    lean = float(np.degrees(np.arctan2(np.hypot(held[0], held[1]), held[2])))
    if np.linalg.norm(held) > 0.9 and lean > max(_MAX_LEAN_DEG, 3 * tilt_sigma_deg):
        logger.warning(
            "--gps %s: as its positions place the run, the cameras lean by %.0f degrees: unless "
            "they were held so, its altitudes are wrong: add --up auto",
            path,
            lean,
        )


def _moved(
    path: Path, fixes: FrameFixes, lag: float, times: np.ndarray, positions: np.ndarray
) -> tuple[FrameFixes, np.ndarray]:
    """Fixes that are behind their frames by a lag, seconds, and the run's positions (G, 3) there;
    times (F,) and positions (F, 3) are of all refined frames."""
    assert fixes.times is not None  # lags are seconds
    logger.warning(
        "--gps %s: its positions are %.2f s %s the frames by the shapes of both paths; they were "
        "moved by that: if it is wrong, check the file's times",
        path,
        abs(lag),
        "behind" if lag > 0 else "ahead of",
    )
    at, known = positions_at(fixes.times - lag, times, positions)
    return fixes.taken(known), at[known]


def _require_majority(
    path: Path, used: np.ndarray, off: np.ndarray, frames: FrameSet, rows: np.ndarray, advice: str
) -> None:
    """Raise GsbaError, naming them, unless most of a file's positions (rows of frames) agree."""
    if 2 * used.sum() > len(used):
        return
    false = rows[~used]
    names = [f"{frames.names[f]} ({frames.timestamps[f]:.3f} s)" for f in false[:_NUM_NAMED]]
    more = f" and {len(false) - _NUM_NAMED} more" if len(false) > _NUM_NAMED else ""
    raise GsbaError(
        f"{path}: {len(false)} of {len(used)} positions contradict the run, by "
        f"{np.median(off[~used]):.3g} units in the median, more than their noise and the run's "
        f"drift allow: those of frames {', '.join(names)}{more}; remove false positions, or check "
        f"that the file is of this recording and on the frames' clock; {advice}"
    )


def _require_determined(path: Path, found: GpsFit, fixes: FrameFixes) -> None:
    """Raise GsbaError if the fixes do not determine scale, heading or tilt."""
    extent = float(np.linalg.norm(np.ptp(fixes.positions[found.used], axis=0)[:2]))
    noise = float(np.median(fixes.sigmas[:, 0]))
    known = f"they spread over {extent:.3g} m with a sigma of {noise:.2g} m"
    if not found.scale_sigma < 0.3:
        raise GsbaError(
            f"{path}: its positions determine the scale only to {100 * found.scale_sigma:.0f} % "
            f"({known}): add --scale lens, or place the run by --scale LENGTH --between A B"
        )
    if not np.degrees(found.heading_sigma) < _MAX_GPS_ANGLE_SIGMA_DEG:
        raise GsbaError(
            f"{path}: its positions determine north only to "
            f"{np.degrees(found.heading_sigma):.0f} degrees ({known}): leave out --gps, or give "
            "positions of a longer walk or of a better receiver"
        )
    if not np.degrees(found.tilt_sigma) < _MAX_GPS_ANGLE_SIGMA_DEG:
        raise GsbaError(
            f"{path}: its positions determine the vertical only to "
            f"{np.degrees(found.tilt_sigma):.0f} degrees: add --up auto"
        )


def _aligned(reconstruction: Reconstruction, frames: FrameSet, path: Path) -> Placement:
    truth = read_trajectory(path)
    if not frames.timed:
        raise GsbaError(
            f"{path}: the frames have no times to match true poses with: refine with --timestamps"
        )
    if any(frames.clock_shifts):
        logger.warning(
            "--align %s: its times are taken for those of the run's trajectory.tum, where several "
            "recordings follow one another: poses on a recording's own clock end up elsewhere",
            path,
        )
    run = Trajectory(frames.timestamps, reconstruction.world_T_rigs)
    rows, of_truth = matched_in_time(run, truth, _TOLERANCE_S)
    good = reconstruction.pose_statuses[rows] == PoseStatus.REFINED
    rows, of_truth = rows[good], of_truth[good]
    if len(rows) < 3:
        raise GsbaError(
            f"{path}: {len(rows)} of its poses are within {_TOLERANCE_S} s of a refined frame; 3 "
            "are needed: check that both use one clock"
        )
    true_T_rigs = truth.world_T_rigs[of_truth]
    world_T_rigs = reconstruction.world_T_rigs[rows]
    source, target = world_T_rigs[:, :3, 3], true_T_rigs[:, :3, 3]
    straight = extents(source)[1] <= _MIN_EXTENT_RATIO
    with naming(path):
        if straight:  # its positions determine no roll, but orientations do
            fit = pose_similarity(world_T_rigs, true_T_rigs)
            used = residuals_of(fit, source, target) <= MAX_DRIFT_SHARE * extent_of(target)
        else:
            limits = np.zeros(len(rows)), MAX_DRIFT_SHARE
            fit, used = robust_similarity(source, target, similarity, 3, *limits)
    residuals = residuals_of(fit, source, target)
    _require_majority(path, used, residuals, frames, rows, "its positions count as exact")
    if is_mirrored(source[used], target[used]):
        raise GsbaError(
            f"{path}: a mirror image of its positions fits at least twice as well: its world is "
            "left-handed; reverse or swap one of its axes"
        )
    sigma = float(np.sqrt(np.mean(residuals[slice(None) if straight else used] ** 2)))
    grounds = {"file": str(path), "poses": len(rows), "outliers": int(np.sum(~used)), "rmse": sigma}
    unit = "units of the true poses"
    return Placement(fit, unit=unit, grounds={"align": grounds})


def guess_in_scan(
    reconstruction: Reconstruction,
    frames: FrameSet,
    settings: PlacementSettings,
    scan: Scan,
    gps: GpsSettings | None = None,
    whole: FrameSet | None = None,
) -> tuple[Guess, dict[str, Any]]:
    """Initial guess of a run's placement in a scan, in its world less its offset, by `pairs`, else
    `gps`, else `up`, and entries of transform.json on it. GsbaError if files cannot be used, or
    frames have no common up axis. `gps`, `whole`: as of `place`."""
    axis = np.eye(3)["xyz".index(upwards(Path(settings.scan or "")))]
    if settings.pairs is not None:
        path = Path(settings.pairs)
        ends, target = read_pairs(path)
        source = np.array([_point(end, reconstruction, frames) for end in ends])
        if extents(source)[1] <= _MIN_EXTENT_RATIO:
            raise GsbaError(f"{path}: its points lie on a line: add a point off that line")
        with naming(path):
            guess = Guess(similarity=similarity(source, target))
        return guess.without(scan.offset), {"pairs": settings.pairs}
    if settings.gps is not None:
        upright = _upright(reconstruction, frames) if settings.up == "auto" else Placement()
        fixes, path = fixes_of_frames(settings.gps, frames, gps, whole), Path(settings.gps)
        earth = _on_earth(reconstruction, frames, path, fixes, upright, determined=False)
        return _guess_of(earth, axis), earth.grounds
    if settings.up == "auto":
        upright = _upright(reconstruction, frames)
        return Guess(axis=(upright.similarity.rotation.T @ _UP_WORLD, axis)), upright.grounds
    return Guess(), {}


def _guess_of(earth: Placement, axis: np.ndarray) -> Guess:
    """Guess in a scan whose `axis` points up, as wide as a placement by GPS is uncertain."""
    found = earth.grounds["gps"]
    spread = _GUESS_SIGMAS * found["scale_sigma"] / earth.similarity.scale
    tilt, heading = (_GUESS_SIGMAS * found[f"{name}_sigma_deg"] for name in ("tilt", "heading"))
    scale = earth.similarity.scale if spread < 1 else None
    usual = Guess()
    ratio = max(usual.scale_ratio, float(np.exp(min(spread, 1))))
    known: dict[str, Any] = {"scale": scale, "scale_ratio": ratio}
    rotation = _least_turn(np.array([0.0, 0, 1]), axis) @ earth.similarity.rotation
    turn = max(usual.angle_deg, float(np.hypot(tilt, heading)))
    if turn < _MAX_GUESS_ANGLE_DEG:
        return Guess(rotation=rotation, angle_deg=turn, **known)
    if tilt < _MAX_GUESS_ANGLE_DEG:
        ends = rotation.T @ axis, axis
        return Guess(axis=ends, angle_deg=max(usual.angle_deg, tilt), **known)
    return Guess(**known)
