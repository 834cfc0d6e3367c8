"""Registration of a cloud with a scan: all candidate placements are aligned and compared."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.geometry import rotation_angle
from gsba.log import GsbaError
from gsba.scans.fit import Fit, approach, noise_of, reach_of, settle
from gsba.scans.judge import CellGrid, ScanVerdict, verdict
from gsba.scans.search import Guess, candidates, distances
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

logger = logging.getLogger(__name__)

_NUM_CANDIDATES = 16  # that are aligned to the scan
_MAX_SCALE_RATIO = 1.2  # of fit to candidate: a larger change is a collapse
_MIN_DISTANCE = 0.05  # of distinct fits, part of the cloud's size
_MAX_DOUBT = 0.01  # largest p value of the lead over all rivals


class NoPlacementError(GsbaError):
    """A cloud fits a scan in no place, or in several."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Placement of a cloud in a scan, and the evidence for it."""

    fit: Fit
    verdict: ScanVerdict
    rivals: int  # number of other placements that explain about as much
    doubt: float  # p value of the lead over the strongest rival; 0 = there is none
    rival: Sim3 | None = None  # the strongest rival

    def __str__(self) -> str:
        found, sigmas = self.fit.similarity, self.fit.sigmas
        lead = f", better than the next placement at p = {self.doubt:.2g}" if self.rivals else ""
        return (
            f"{100 * self.verdict.share:.0f} % of the cloud's points are on the scan{lead}; scale "
            f"{found.scale:.6g} (sigma {100 * sigmas[6]:.2g} %), sigma of the position "
            f"{max(sigmas[3:6]):.2g} units"
        )

    def to_json(self) -> dict[str, Any]:
        """Plain values for transform.json and reports."""
        sigmas = self.fit.sigmas
        return {
            "explained": round(self.verdict.share, 4),
            "contradicted": round(float(self.verdict.contradicted.mean()), 4),
            "residual_sigma": self.fit.noise.sigma,
            "scale_sigma": float(sigmas[6] * self.fit.similarity.scale),
            "rotation_sigmas_deg": np.degrees(sigmas[:3]).tolist(),
            "translation_sigmas": sigmas[3:6].tolist(),
            "about": self.fit.middle.tolist(),
            "rivals": self.rivals,
            "doubt": self.doubt if self.rivals else None,
        }


@contextmanager
def in_file(path: Path) -> Iterator[None]:
    """Name the file in the message if registration fails."""
    try:
        yield
    except NoPlacementError as error:
        raise GsbaError(f"{path}: {error}") from None


def register(cloud: Cloud, scan: Scan, guess: Guess | None = None) -> Registration:
    """Unique similarity from a cloud to a scan, of those that `guess` allows; NoPlacementError if
    none explains enough, or several do about as well."""
    guess, grid = guess or Guess(), CellGrid(scan)
    fits = _likeliest(cloud, scan, guess, grid, 6)
    if not fits:
        raise NoPlacementError("no part of the scan resembles the run: " + _ADVICE)
    noise = fits[0].noise  # one for all, so that their likelihoods are comparable
    verdicts = [verdict(fit.similarity, cloud, scan, grid, noise) for fit in fits]
    doubts = np.array([[a.doubt(b) for b in verdicts] for a in verdicts])
    shares = np.array([one.share for one in verdicts])
    able = shares >= 0.8 * shares.max()
    worst = np.max(doubts, axis=1, where=able & ~np.eye(len(fits), dtype=bool), initial=0.0)
    best = int(np.argmin(np.where(able, worst, 2.0)))
    rivals = able & (np.arange(len(fits)) != best)
    next_ = int(np.argmax(np.where(rivals, doubts[best], -1.0)))
    rival = fits[next_].similarity if rivals.any() else None
    found = Registration(fits[best], verdicts[best], int(rivals.sum()), float(worst[best]), rival)
    for n, (fit, evidence) in enumerate(zip(fits, verdicts, strict=True)):
        logger.debug(
            "scale %.5g: %.3f explained, %.3f contradicted, p = %.2g of the best one's lead",
            fit.similarity.scale,
            evidence.share,
            evidence.contradicted.mean(),
            doubts[best, n],
        )
    _check(found, reach_of(found.fit.similarity, cloud))
    if guess.similarity is None:
        # A scan that the mirrored cloud fits better cannot be of the same place.
        twin, axis = cloud.mirrored(), guess.axis
        if axis is not None:
            axis = axis[0] * [-1, 1, 1], axis[1]
        for fit in _likeliest(twin, scan, replace(guess, axis=axis, rotation=None), grid, 1):
            evidence = verdict(fit.similarity, twin, scan, grid, found.fit.noise)
            doubt = evidence.doubt(found.verdict)
            logger.debug("mirrored: %.3f explained, p = %.2g of its lead", evidence.share, doubt)
            lead = evidence.share - found.verdict.share
            # a room that is its own mirror image has no lead
            if lead > 0.05 or (lead > 0 and doubt < _MAX_DOUBT):
                raise NoPlacementError(
                    "the mirrored run fits better: the scan is of another building, or its world "
                    "is left-handed: change the sign of one of its axes"
                )
    if found.rival is not None and found.doubt > _MAX_DOUBT / found.rivals:
        best = found.fit.similarity
        turn = np.degrees(rotation_angle(best.rotation.T @ found.rival.rotation))
        raise NoPlacementError(
            "several placements explain the run about equally: the lead of the best over another, "
            f"rotated by {turn:.0f} deg at {found.rival.scale / best.scale:.3g} times the scale, "
            f"has p = {found.doubt:.2g}: start the alignment by --pairs or --gps, or by --up auto "
            "if one of them is not upright; or give a scan with colours"
        )
    return found


def _likeliest(cloud: Cloud, scan: Scan, guess: Guess, grid: CellGrid, most: int) -> list[Fit]:
    """Fits of the placements that explain most of a cloud, the best first, at most `most`."""
    near = _aligned(candidates(cloud, scan, guess, _NUM_CANDIDATES), cloud, scan)
    noises = [noise_of(fit, cloud, scan, sigma) for fit, sigma in near]
    shares = [
        verdict(fit, cloud, scan, grid, noise).share
        for (fit, _), noise in zip(near, noises, strict=True)
    ]
    order = np.argsort([-share for share in shares], kind="stable")[:most]
    return [settle(near[n][0], cloud, scan, noises[n].sigma) for n in order]


_ADVICE = (
    "check that it is of the same place, or start the alignment by --pairs, --gps or --up auto"
)


def _check(found: Registration, reach: float) -> None:
    """Refuse a placement that explains too little, or only by a noise that no run has."""
    evidence, sigma = found.verdict, found.fit.noise.sigma
    if sigma > reach:
        raise NoPlacementError(
            f"no placement explains the run: in the best, its points are {sigma:.3g} units (rms) "
            f"off the scan's surfaces, and {reach:.3g} are allowed: " + _ADVICE
        )
    if evidence.share < 0.25 or evidence.agreement < 0.75:
        raise NoPlacementError(
            f"no placement explains the run: in the best, {100 * evidence.share:.0f} % of its "
            f"points are on the scan's surfaces, and {100 * evidence.contradicted.mean():.0f} % "
            "contradict it: " + _ADVICE
        )


def _aligned(starts: Sequence[Sim3], cloud: Cloud, scan: Scan) -> list[tuple[Sim3, float]]:
    """Distinct similarities that candidates converge to, with the residuals' sigma at each."""
    near: list[tuple[Sim3, float]] = []
    for start in starts:
        # part of the cloud's size
        fit, sigma = approach(start, cloud, scan, 0.08 * cloud.size * start.scale)
        same = distances(fit, [other for other, _ in near], cloud) < _MIN_DISTANCE
        if 1 / _MAX_SCALE_RATIO < fit.scale / start.scale < _MAX_SCALE_RATIO and not same.any():
            near.append((fit, sigma))
    return near
