"""The family of GPS fixes: fixes of frames, carried into the map, hold its poses against drift.

The similarity between the map and level metres is no variable of the adjustment. It is found from
the poses at the start of each, and defines the coordinates: as the fixes then determine place,
heading and scale, the first pose is not held, and the map is free to move, turn and grow to where
fixes and images agree best. That is the joint optimum of poses and similarity, since observations
say nothing of the gauge; the result is carried back to the trajectory's world in the end. Holding
the first pose and re-estimating the similarity in turns would approach it slowly, a shared
variable would tie all frames to one another.

Errors of fixes last, see `FrameFixes`. The adjustment has independent ones that say as much of
drift, so that each fix is a factor of its own, with a robust loss. Covariances have the lasting
errors as variables; and as they are of the gauge that holds the first pose, the similarity as well,
all by factors that are linear.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factors import RobustLoss
from gsba.bundle.families import Family, MapSnapshot, digest_of, numbered
from gsba.bundle.pose_variables import X, values_of
from gsba.bundle.trajectory_prior import LOSS_SIGMAS
from gsba.geometry import extent_of
from gsba.significance import MEDIAN_NORMAL_LENGTH, OUTLIER_LENGTH
from gsba.similarity import NoSimilarityError, Sim3, robust_similarity, similarity

WHITE_SHARE = 0.1  # of the variance of a fix: independent from fix to fix, the rest lasts
# Largest ratio of the true noise of fixes to the claimed one. Claims hold under an open sky: with
# the default of 3 m it is 10.5 m per axis, a mean horizontal error of 13 m, the largest that
# Merry and Bettinger (PLoS ONE 14(7), e0219890, 2019) measured with a phone in a town.
_MAX_NOISE_RATIO = 3.5
MAX_DRIFT_SHARE = 0.05  # largest error of a map's positions, part of their extent


@dataclass(frozen=True, slots=True)
class FrameFixes:
    """GPS positions of frames in a local level frame, with a model of their errors.

    Errors of neighbouring fixes are alike: satellites, atmosphere and reflections change slowly.
    The error of each axis is a first-order Gauss-Markov process, with white noise beside it.
    "Comparison of Enhanced Noise Model Performance Based on Analysis of Civilian GPS Data"
    (Sensors 20(21), 6050, 2020) finds such processes to describe recordings of receivers at rest;
    D. L. Wilson measured a correlation time of about a minute on handheld receivers
    (erols.com/dlwilson/gpscorr.htm), and the Gazebo simulator's GPS has the same.
    """

    frames: np.ndarray  # (G,) int64, ascending
    positions: np.ndarray  # (G, 3) float64, metres east, north and up of the origin
    sigmas: np.ndarray  # (G, 3) float64, metres east, north and up, standard deviations
    times: np.ndarray | None  # (G,) float64, seconds, ascending; None = not known
    origin: np.ndarray  # (3,) float64, latitude, longitude (degrees), altitude (metres)
    correlation_s: float  # time constant of the errors, seconds

    def __len__(self) -> int:
        return len(self.frames)

    def taken(self, chosen: np.ndarray) -> "FrameFixes":
        """Some of the fixes, by a mask or ascending rows."""
        times = None if self.times is None else self.times[chosen]
        return FrameFixes(
            self.frames[chosen],
            self.positions[chosen],
            self.sigmas[chosen],
            times,
            self.origin,
            self.correlation_s,
        )

    def tolerances(self) -> np.ndarray:
        """Largest error (G,) of a fix, metres, by its claimed noise."""
        return OUTLIER_LENGTH * np.sqrt(np.mean(self.sigmas**2, axis=1))

    def inliers(self, residuals: np.ndarray, extent: float) -> tuple[np.ndarray, float]:
        """Fixes that agree with a map, and the scatter of all.

        The gate is 4.6 standard deviations, or 4.6 times the scatter of all fixes if that is
        larger. Where the scatter exceeds the largest noise of receivers and the largest drift of a
        map, most fixes are false: the gate is then the median that these two allow, which fewer
        than half of the fixes pass.

        Args:
            residuals: (G, 3) fixes less the transformed positions of their frames, metres.
            extent: of the frames' transformed positions, metres.

        Returns:
            (G,) bool, and the scatter in standard deviations of the fixes, at least 1.
        """
        distances = np.linalg.norm(residuals / self.sigmas, axis=1)
        drift = MAX_DRIFT_SHARE * extent / OUTLIER_LENGTH / float(np.median(self.sigmas[:, 0]))
        most = float(np.hypot(_MAX_NOISE_RATIO, drift))
        scatter = max(1.0, float(np.median(distances)) / MEDIAN_NORMAL_LENGTH)
        if scatter > most:
            return distances < MEDIAN_NORMAL_LENGTH * most, most
        return distances <= OUTLIER_LENGTH * scatter, scatter

    def correlations(self) -> np.ndarray:
        """Correlation (G - 1,) of the lasting part of the errors of each fix and the next."""
        if self.times is None:
            return np.full(max(len(self) - 1, 0), np.exp(-0.5))  # correlation times between fixes
        return np.exp(-np.diff(self.times) / self.correlation_s)

    def whitened(self, columns: np.ndarray) -> np.ndarray:
        """Columns (G, 3, ...) of a linear model of the positions, metres, residuals or Jacobians by
        anything, in units of independent errors.

        The innovations of a Kalman filter of the errors: their sum of squares is that of `columns`
        weighted with the inverse covariance of all fixes (Kailath, IEEE TAC 13, 1968).
        """
        scaled = columns / self.sigmas.reshape(*self.sigmas.shape, *[1] * (columns.ndim - 2))
        correlations = np.concatenate([[0.0], self.correlations()])
        lasting = 1 - WHITE_SHARE
        mean, variance = np.zeros(scaled.shape[1:]), lasting
        out = np.empty_like(scaled)
        for i, correlation in enumerate(correlations):
            mean = correlation * mean
            variance = correlation**2 * variance + (1 - correlation**2) * lasting
            total = variance + WHITE_SHARE
            innovation = scaled[i] - mean
            out[i] = innovation / np.sqrt(total)
            mean = mean + variance / total * innovation
            variance *= 1 - variance / total
        return out

    def independent_sigmas(self) -> np.ndarray:
        """Standard deviations (G, 3), metres, of independent errors that say as much.

        White noise of the same spectral density at long periods: what fixes say of drift, and of
        their mean, is then neither more nor less than their lasting errors allow. Of shorter
        periods, about which images know more, they say less.
        """
        steps = self.correlations()
        if not len(steps):
            return self.sigmas
        around = np.sqrt(np.append(steps, steps[-1]) * np.insert(steps, 0, steps[0]))
        lasting = (1 - WHITE_SHARE) * (1 + around) / np.maximum(1 - around, 1e-9)
        return self.sigmas * np.sqrt(lasting + WHITE_SHARE)[:, None]


MIN_FIXES = 5  # in a map: seven unknowns leave little of fewer

S: Callable[[int], int] = gtsam.symbol_shorthand.S  # what a map's similarity changes by (7,)
E: Callable[[int], int] = gtsam.symbol_shorthand.E  # lasting error of a fix (3,), in its sigmas


@dataclass(frozen=True, slots=True)
class Anchors:
    """Fixes carried into the world of a map, in map units; false ones are left out."""

    frames: np.ndarray  # (A,) int64, frame of each
    positions: np.ndarray  # (A, 3) float64, world, map units
    covariances: np.ndarray  # (A, 3, 3) float64, map units^2, of independent errors
    loss_scales: np.ndarray  # (A,) float64, of the Cauchy loss, in standard deviations of these
    maps: np.ndarray  # (A,) int64, map of each
    fixes: FrameFixes  # (A) the same in level metres
    used: np.ndarray  # (G,) bool, fixes of the frames that are among them
    level_from_map: dict[int, Sim3]  # of each map that has fixes: metres east, north, up

    def weights(self, world_T_rigs: np.ndarray) -> np.ndarray:
        """Weights (A,) of the Cauchy loss under these poses (F, 4, 4)."""
        off = world_T_rigs[self.frames, :3, 3] - self.positions
        squares = np.einsum("ai,aij,aj->a", off, np.linalg.inv(self.covariances), off)
        return 1 / (1 + squares / self.loss_scales**2)


def anchor(
    world_T_rigs: np.ndarray, fixes: FrameFixes, maps: np.ndarray | None = None
) -> Anchors | None:
    """Fixes carried into the world of poses (F, 4, 4), each map by a similarity of its own; None
    where no map has enough fixes of which most lie as its frames do.

    Fixes outside of the gate are left out, see `FrameFixes.inliers`; the scale of the loss is as
    wide as the gate. maps: (F,) map of each frame; None = there is one.
    """
    positions = world_T_rigs[fixes.frames, :3, 3]
    of_fix = numbered(maps, len(world_T_rigs))[fixes.frames]
    found, rows, wide = dict[int, Sim3](), [np.zeros(0, np.int64)], np.ones(len(fixes))
    for number in np.unique(of_fix).tolist():
        inside = np.flatnonzero(of_fix == number)
        if len(inside) < MIN_FIXES:
            continue
        try:
            fit, used, scatter = _level_from_map(positions[inside], fixes.taken(inside))
        except NoSimilarityError:
            continue
        found[number], wide[inside] = fit, scatter
        rows.append(inside[used])
    if not found:
        return None
    chosen = np.sort(np.concatenate(rows))
    of_fix, kept = of_fix[chosen], fixes.taken(chosen)
    sigmas, scales = kept.independent_sigmas(), LOSS_SIGMAS * wide[chosen]
    places, covariances = np.empty((len(chosen), 3)), np.empty((len(chosen), 3, 3))
    for a, number in enumerate(of_fix.tolist()):
        fit = found[number]
        axes = fit.rotation.T * (sigmas[a] / fit.scale)
        covariances[a], places[a] = axes @ axes.T, fit.points_back(kept.positions[a])
    loss = scales * kept.sigmas[:, 0] / sigmas[:, 0]
    mask = np.isin(np.arange(len(fixes)), chosen)
    return Anchors(kept.frames, places, covariances, loss, of_fix, kept, mask, found)


def _level_from_map(positions: np.ndarray, fixes: FrameFixes) -> tuple[Sim3, np.ndarray, float]:
    """Map's similarity, fixes (G,) that agree, and their scatter in units of their noise, >= 1."""
    limits = fixes.tolerances(), MAX_DRIFT_SHARE
    fit, used = robust_similarity(positions, fixes.positions, similarity, 3, *limits)
    scatter = 1.0
    for _ in range(10):  # of choosing fixes
        extent = fit.scale * extent_of(positions)
        before = used
        used, scatter = fixes.inliers(fixes.positions - fit.points(positions), extent)
        if 2 * used.sum() <= len(used):
            raise NoSimilarityError(f"only {used.sum()} of {len(used)} positions agree")
        if np.array_equal(before, used):
            break
        fit = similarity(positions[used], fixes.positions[used])
    return fit, used, scatter


def contradiction(anchors: Anchors, world_T_rigs: np.ndarray, draws: np.ndarray) -> float:
    """Ratio of the observed to the expected bending of a map by the fixes it was adjusted with.

    The pull of the fixes at the optimum is that of the images, with the other sign: without fixes,
    the map would move by the images' covariance times this pull. The square of that motion, in
    standard deviations of the images, is expected to be at most the number of independent motions
    that fixes know better than images.

    Args:
        world_T_rigs: (F, 4, 4) adjusted poses.
        draws: (D, F, 6) errors of the poses by images alone, rig frames; NaN = none.

    Returns:
        Ratio of both, of the map that is bent most; about 1 or less if errors are as claimed.
    """
    known = np.asarray(np.isfinite(draws).all(axis=(0, 2)))
    weights = anchors.weights(world_T_rigs)
    worst = 0.0
    for number in anchors.level_from_map:
        rows = np.flatnonzero(np.logical_and(anchors.maps == number, known[anchors.frames]))
        if len(rows) < MIN_FIXES:
            continue
        frames, places = anchors.frames[rows], anchors.positions[rows]
        information = np.linalg.inv(anchors.covariances[rows]) * weights[rows, None, None]
        arms = places - places.mean(axis=0)
        gauge = np.stack(
            [
                arms,
                *np.cross(np.eye(3)[:, None], arms),
                *np.repeat(np.eye(3)[:, None], len(rows), axis=1),
            ],
            axis=2,
        )
        pulled = np.einsum("aij,ajk->aik", information, gauge)
        inverse = np.linalg.pinv(np.einsum("aik,ail->kl", gauge, pulled), hermitian=True)

        def in_shape(
            off: np.ndarray, pulled: np.ndarray = pulled, back: np.ndarray = gauge @ inverse
        ) -> np.ndarray:
            """Offsets (D, A, 3) after the best similarity."""
            return off - np.einsum("aik,dk->dai", back, np.einsum("aik,dai->dk", pulled, off))

        off = in_shape((world_T_rigs[frames, :3, 3] - places)[None])[0]
        turns = world_T_rigs[frames, :3, :3]
        moved = in_shape(np.einsum("aij,daj->dai", turns, draws[:, frames, 3:]))
        pull = np.einsum("aij,aj->ai", information, off)
        bent = np.mean(np.einsum("ai,dai->d", pull, moved) ** 2)
        expected = np.mean(np.einsum("dai,aij,daj->d", moved, information, moved))
        worst = max(worst, float(bent / np.clip(expected, 1.0, 3 * len(rows))))
    return worst


@dataclass(frozen=True, slots=True)
class GpsFactors(Family):
    """Fixes of frames; each adjustment carries them into its map anew."""

    name = "gps"
    limits_drift = True

    fixes: FrameFixes
    contradicted: bool = False  # by the images: they are left out, and only reported

    @property
    def digest(self) -> str:
        """Digest of the fixes and of the scale of the loss."""
        fixes = self.fixes
        measured = fixes.frames, fixes.positions, fixes.sigmas, fixes.times, fixes.correlation_s
        return digest_of(*measured, LOSS_SIGMAS, self.contradicted)

    def fitted(self, snapshot: MapSnapshot) -> "AnchoredFixes | None":
        """The fixes in the world of these poses; None where these contradict them."""
        anchors = self._anchors(snapshot)
        return None if anchors is None else AnchoredFixes(anchors, self.digest)

    def contradiction(self, snapshot: MapSnapshot, draws: np.ndarray) -> float:
        """Ratio by which the fixes bend a map that was adjusted with them, see `contradiction`."""
        anchors = self._anchors(snapshot)
        return 0.0 if anchors is None else contradiction(anchors, snapshot.world_T_rigs, draws)

    def _anchors(self, snapshot: MapSnapshot) -> Anchors | None:
        if self.contradicted:
            return None
        return anchor(snapshot.world_T_rigs, self.fixes, snapshot.maps)

    def report(self, snapshot: MapSnapshot) -> Mapping[str, Any]:
        """Used and false fixes, and their residuals in metres."""
        fixes, poses = self.fixes, snapshot.world_T_rigs
        anchors = self._anchors(snapshot)
        of_fix = snapshot.maps[fixes.frames]
        content: dict[str, Any] = {
            "fixes": len(fixes),
            "taken": anchors is not None,
            "too_few_in_each_map": bool(np.bincount(of_fix, minlength=1).max() < MIN_FIXES),
        }
        if anchors is None:
            return content | {"used": 0, "contradicted": self.contradicted}
        used, judged = np.flatnonzero(anchors.used), np.isin(of_fix, [*anchors.level_from_map])
        off = np.empty((len(used), 3))
        for number, fit in anchors.level_from_map.items():
            inside = anchors.maps == number
            carried = fit.points(poses[anchors.frames[inside], :3, 3])
            off[inside] = carried - fixes.positions[used[inside]]
        lengths = np.linalg.norm(off, axis=1)
        return content | {
            "used": len(used),
            "false_fixes": [snapshot.names[f] for f in fixes.frames[judged & ~anchors.used]],
            "fixes_elsewhere": int(np.count_nonzero(~judged)),  # of maps that they do not place
            "residual_m": {"median": np.median(lengths), "most": lengths.max()},
            "rms_m_east_north_up": np.sqrt(np.mean(off**2, axis=0)),
            "sigma_m_east_north_up": np.median(fixes.sigmas, axis=0),
            "metres_per_unit": {str(n): fit.scale for n, fit in anchors.level_from_map.items()},
        }


@dataclass(frozen=True, slots=True)
class AnchoredFixes(Family):
    """Fixes in the world of a map, for one adjustment."""

    name = "gps"
    limits_drift = True
    reserved_letters = "es"

    anchors: Anchors
    digest: str
    lasting: bool = False  # their lasting errors are variables: see `linear_factors`

    def holds_gauge(self, snapshot: MapSnapshot) -> bool:
        """True if the map of the first frame has fixes."""
        return int(snapshot.maps[0]) in self.anchors.level_from_map

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """A factor for each fix, or linear ones, weighted by the loss at these poses."""
        if self.lasting:
            return linear_factors(self.anchors, snapshot.world_T_rigs)[0]
        return factors(self.anchors)

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """None, or lasting errors of fixes and similarities of maps."""
        if self.lasting:
            return linear_factors(self.anchors, snapshot.world_T_rigs)[1]
        return gtsam.Values()

    def for_covariances(self, snapshot: MapSnapshot) -> "AnchoredFixes":
        """The fixes with their lasting errors as variables."""
        return replace(self, lasting=True)


def factors(anchors: Anchors) -> gtsam.NonlinearFactorGraph:
    """GTSAM's GPS factors under a Cauchy loss, one for each fix."""
    graph = gtsam.NonlinearFactorGraph()
    for a, frame in enumerate(anchors.frames.tolist()):
        noise = gtsam.noiseModel.Gaussian.Covariance(anchors.covariances[a])
        model = RobustLoss("cauchy", float(anchors.loss_scales[a])).noise_model(noise)
        graph.add(gtsam.GPSFactor(X(frame), anchors.positions[a], model))
    return graph


def linear_factors(
    anchors: Anchors, world_T_rigs: np.ndarray
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Linear factors of fixes for covariances, and the variables beside the poses: lasting errors,
    and the map's similarity, as it must be free where the first pose is held. They are linearized
    at poses (F, 4, 4) and weighted as the loss weighs them there."""
    graph, weights = gtsam.NonlinearFactorGraph(), anchors.weights(world_T_rigs)
    own = gtsam.Values()
    for a in range(len(anchors.frames)):
        own.insert(E(a), np.zeros(3))
    for number in anchors.level_from_map:
        own.insert(S(number), np.zeros(7))
    values = values_of(world_T_rigs, own)
    for number, fit in anchors.level_from_map.items():
        chosen = np.flatnonzero(anchors.maps == number)
        fixes, middle = anchors.fixes.taken(chosen), anchors.positions[chosen].mean(axis=0)
        memories = np.concatenate([[0.0], fixes.correlations()])
        for i, a in enumerate(chosen.tolist()):
            fresh = 1 / np.sqrt((1 - WHITE_SHARE) * (1 - memories[i] ** 2))
            link = {E(a): fresh * np.eye(3)}
            if i:
                link |= {E(int(chosen[i - 1])): -fresh * memories[i] * np.eye(3)}
            graph.add(_linear(link, np.zeros(3), values))
            frame = int(anchors.frames[a])
            off = world_T_rigs[frame, :3, 3] - anchors.positions[a]
            arm = anchors.positions[a] - middle
            weight = np.sqrt(weights[a] / WHITE_SHARE)
            whitened = weight * fit.scale * fit.rotation / fixes.sigmas[i][:, None]
            by_pose = np.hstack([np.zeros((3, 3)), world_T_rigs[frame, :3, :3]])
            terms = {X(frame): whitened @ by_pose, E(a): -weight * np.eye(3)}
            by_similarity = np.column_stack([arm, *np.cross(np.eye(3), arm), np.eye(3)])
            terms[S(number)] = -whitened @ by_similarity
            graph.add(_linear(terms, -whitened @ off, values))
    return graph, own


def _linear(
    terms: dict[int, np.ndarray], right: np.ndarray, values: gtsam.Values
) -> gtsam.LinearContainerFactor:
    """A linear factor of up to three variables, linearized at these values."""
    here = gtsam.Values()
    for key, matrix in terms.items():
        if matrix.shape[1] == 6:
            here.insert(key, values.atPose3(key))
        else:
            here.insert(key, values.atVector(key))
    parts = [part for term in terms.items() for part in term]
    unit = gtsam.noiseModel.Unit.Create(3)
    rows = gtsam.JacobianFactor(*parts, right, unit)  # type: ignore[call-overload]
    return gtsam.LinearContainerFactor(rows, here)
