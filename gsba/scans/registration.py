"""A cloud onto a scan: all that may be its place is tried, and what the scan says decides."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsba.log import GsbaError
from gsba.scans.fit import Fit, approach, settle
from gsba.scans.judge import Grid, Verdict, verdict
from gsba.scans.noise import noise_of
from gsba.scans.search import Guess, candidates, distance
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

logger = logging.getLogger(__name__)

_TRIED = 16  # candidates that are laid on the scan
_JUDGED = 6  # of them, the likeliest, with all of the cloud
_WIDTH = 0.08  # of the cloud's size: of the loss at first
_STRAY = 1.2  # of a scale, from candidate to fit: more is a collapse
_SAME = 0.05  # of the cloud's size: fits nearer than this are one
_RIVALS = 0.8  # of the best one's share: placements that explain less are none
_LEAST_SHARE = 0.25  # of the cloud, explained
_LEAST_AGREEMENT = 0.75  # explained, of what the scan says something about
_MOST_DOUBT = 0.01  # chance that a placement leads although another is as good, over all others


class NoPlacementError(GsbaError):
    """A cloud has no place in a scan, or several."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Where a cloud is in a scan, and what speaks for it."""

    fit: Fit
    verdict: Verdict
    rivals: int  # other placements that explain about as much
    doubt: float  # p value of the lead over the nearest of them; 0 = there is none
    rival: Sim3 | None = None  # that one

    def __str__(self) -> str:
        found, sigmas = self.fit.similarity, self.fit.sigmas
        lead = f", before the next at p = {self.doubt:.2g}" if self.rivals else ""
        return (
            f"{100 * self.verdict.share:.0f} % of the cloud explained{lead}; scale "
            f"{found.scale:.6g} to {100 * sigmas[6]:.2g} %, place to {max(sigmas[3:6]):.2g} units"
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
    """Say which file a cloud has no place in."""
    try:
        yield
    except NoPlacementError as error:
        raise GsbaError(f"{path}: {error}") from None


def register(cloud: Cloud, scan: Scan, guess: Guess | None = None) -> Registration:
    """The similarity that carries a cloud onto a scan, if there is one and one only.

    Args:
        guess: what is known beforehand; nothing else is tried.

    Raises:
        NoPlacementError: no placement explains enough, or several do about as well.
    """
    guess, grid = guess or Guess(), Grid(scan)
    fits = _likeliest(cloud, scan, guess, grid, _JUDGED)
    if not fits:
        raise NoPlacementError("nothing in it resembles the run: " + _ADVICE)
    noise = fits[0].noise  # one for all, so that their likelihoods compare
    verdicts = [verdict(fit.similarity, cloud, scan, grid, noise) for fit in fits]
    doubts = np.array([[a.doubt(b) for b in verdicts] for a in verdicts])
    shares = np.array([said.share for said in verdicts])
    able = shares >= _RIVALS * shares.max()
    worst = np.max(doubts, axis=1, where=able & ~np.eye(len(fits), dtype=bool), initial=0.0)
    best = int(np.argmin(np.where(able, worst, 2.0)))
    rivals = able & (np.arange(len(fits)) != best)
    next_ = int(np.argmax(np.where(rivals, doubts[best], -1.0)))
    rival = fits[next_].similarity if rivals.any() else None
    found = Registration(fits[best], verdicts[best], int(rivals.sum()), float(worst[best]), rival)
    for n, (fit, said) in enumerate(zip(fits, verdicts, strict=True)):
        logger.debug(
            "scale %.5g: %.3f explained, %.3f contradicted, %.2g to be as good as the best",
            fit.similarity.scale,
            said.share,
            said.contradicted.mean(),
            doubts[best, n],
        )
    _check(found)
    if guess.similarity is None:
        _check_handed(found, cloud, scan, guess, grid)
    _check_alone(found)
    return found


def _likeliest(cloud: Cloud, scan: Scan, guess: Guess, grid: Grid, most: int) -> list[Fit]:
    """Placements that explain most of a cloud, the best first."""
    near = _laid(candidates(cloud, scan, guess, _TRIED), cloud, scan)
    noises = [noise_of(fit, cloud, scan, sigma) for fit, sigma in near]
    shares = [
        verdict(fit, cloud, scan, grid, noise).share
        for (fit, _), noise in zip(near, noises, strict=True)
    ]
    order = np.argsort([-share for share in shares], kind="stable")[:most]
    return [settle(near[n][0], cloud, scan, noises[n].sigma) for n in order]


_ADVICE = "check that it is of the same place, or tell where: --pairs, --gps or --up auto"


def _check(found: Registration) -> None:
    said = found.verdict
    if said.share < _LEAST_SHARE or said.agreement < _LEAST_AGREEMENT:
        raise NoPlacementError(
            f"no placement explains the run: the best has {100 * said.share:.0f} % of its points "
            f"on the scan's surfaces, and {100 * said.contradicted.mean():.0f} % contradict it: "
            + _ADVICE
        )


def _check_handed(found: Registration, cloud: Cloud, scan: Scan, guess: Guess, grid: Grid) -> None:
    """Refuse a scan that the cloud in a mirror fits better: it cannot be of the same place."""
    twin, axis = cloud.mirrored(), guess.axis
    if axis is not None:
        axis = axis[0] * [-1, 1, 1], axis[1]
    for fit in _likeliest(twin, scan, Guess(scale=guess.scale, axis=axis), grid, 1):
        said = verdict(fit.similarity, twin, scan, grid, found.fit.noise)
        doubt = said.doubt(found.verdict)
        logger.debug("in a mirror: %.3f explained, %.2g that it leads by chance", said.share, doubt)
        if said.share > found.verdict.share and doubt < _MOST_DOUBT:
            raise NoPlacementError(
                "the run in a mirror fits better: the scan is of another building, or its world is "
                "left-handed: change the sign of one of its axes"
            )


def _check_alone(found: Registration) -> None:
    """Refuse a place that others explain as well."""
    if found.rival is not None and found.doubt > _MOST_DOUBT / found.rivals:
        best = found.fit.similarity
        cosine = (np.trace(best.rotation.T @ found.rival.rotation) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        raise NoPlacementError(
            f"several placements explain the run about equally: the best leads another, turned by "
            f"{turn:.0f} deg at {found.rival.scale / best.scale:.3g} times the scale, at p = "
            f"{found.doubt:.2g} only: tell where by --pairs or --gps, or by --up auto if one of "
            "them is not upright; or give a scan with colours"
        )


def _laid(starts: Sequence[Sim3], cloud: Cloud, scan: Scan) -> list[tuple[Sim3, float]]:
    """Distinct similarities that candidates lead to, and what distances scatter by at each."""
    near: list[tuple[Sim3, float]] = []
    for start in starts:
        fit, sigma = approach(start, cloud, scan, _WIDTH * cloud.size * start.scale)
        same = (distance(fit, other, cloud) < _SAME for other, _ in near)
        if 1 / _STRAY < fit.scale / start.scale < _STRAY and not any(same):
            near.append((fit, sigma))
    return near
