"""Time that a refinement still takes, from its events: costs by a table, at the speed so far. It is
a range, from the least to the most that is still possible: nothing tells beforehand whether two
lenses will be found, weak frames need more keypoints, or patches a third round."""

import logging
import math
import re
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsba.config import RefineSettings
from gsba.log import event
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

# Phases of a refinement, regular expressions of their stages. They come in this order, and from the
# second one on again where raw frames are cut anew or a video gives more frames.
PHASES = (
    r"carrier\d*|segmented|distractors\d*|masks|frames|expected_drift|fetch\d+|recut.*",
    r"features|keypoints",
    r"(blank|odd)_frames|neighbours.*|clock|turn|steps|likeness|order|(features|keypoints)_tour|imu|gauge",
    r"chain2?|adjacent|near|dense",
    r"registered|across\w*|similarities|joined|adjacent2|loops2?|places|gauge_closed|closed"
    r"|imu_closed",
    r"axes|lens(es|ed)\d+|seam|stitch(ed|_radius(_tried)?)|settled(_far)?(_readout)?|(re)?calibrated\d*(_readout)?"
    r"|(adjacent|wide)_(lenses|stitched|raw\d+)|imu_camera|strength",
    r".*_closer",
    r"everywhere\d+|refined\d+|again_.*",
    r"\w*align(ed)?1(_\w+)?|stitching1|settled_aligned2",
    r"\w*align(ed)?2(_\w+)?|stitching2|settled_aligned3",
    r"\w*align(ed)?3(_\w+)?|stitching3|settled_aligned4",
    r"\w*align(ed)?([4-9]|\d\d+)(_\w+)?|stitching([4-9]|\d\d+)|settled_aligned([5-9]|\d\d+)",
    r"imu_final|camera|reconstruction|lenses|map|export-.*",
)
FEATURES, CAMERA, WEAK, KNOWN, FIRST_PATCHES, LAST_PATCHES = 1, 5, 6, 7, 8, 11  # of phases
_PATCHES = range(FIRST_PATCHES, LAST_PATCHES + 1)
OPTIONAL = {WEAK, FIRST_PATCHES + 2, LAST_PATCHES}  # phases that what was found so far decides on
# Of each phase: share of its seconds in which one thread works alone, and coefficients of
# `Size.terms`, seconds on two cores. Made by `python -m benchmarks.time_left fit`.
_COSTS = (
    (0.586, 0.211, 0, 0.00338, 0, 0, 0, 0, 0.01, 0.0136),
    (0.0246, 0.0791, 0.0161, 0.00024, 0.0318, 0, 0, 0.00946, 0, 0.0156),
    (0.113, 0.0772, 0.0111, 4.07e-05, 0.00473, 0.0168, 0, 0.00656, 0, 0),
    (0.465, 0.0601, 0.00743, 0.000394, 0.00248, 0, 0, 0.000324, 0.00225, 0.00556),
    (0.457, 0.067, 0.00936, 0, 0.0029, 0, 0, 0.0331, 0, 0),
    (0.637, 0.046, 0.00028, 0.000618, 0.00709, 0.00145, 0.0368, 0.00804, 0.203, 0.00638),
    (0.0617, 0.069, 0.0163, 0.00124, 0, 0.0286, 0, 0.00909, 0.0057, 0),
    (0.333, 0.0607, 0.0122, 0, 0, 0, 0, 0, 0, 0),
    (0.594, 0.0707, 0.0129, 0.0108, 0, 0, 0.0833, 0, 0.0149, 0),
    (0.584, 0.0197, 0.0136, 0.00919, 0, 0, 0.0646, 0, 0.0055, 0),
    (0.607, 0.15, 0.00605, 0.00755, 0, 0.000629, 0.0593, 0, 0.0154, 0),
    (0.601, 0, 0, 0.00724, 0, 0, 0.0263, 0.026, 0.0124, 0),
    (0.65, 0.267, 0.000903, 0.0439, 0, 0, 0.000523, 0.0171, 0, 0),
)
# Probability that two lenses are found in panoramas, by `camera.model`; None = not known
# beforehand. Patches then take five times as long.
_LENSES = {"auto": None, "central": 0.0, "two_lens": 1.0}
_OBSERVATIONS = 950.0  # of the map for each frame
_ODOMETRY, _TRACKING = "odometry", "tracking"  # stage, and its work
_TOUR = "tour"  # stage of few runs, whose own work tells the time of it
_SEARCH = "searching along epipolar lines"  # its work, before maps are joined
_JOINING = (0.2, 0.6)  # least and most seconds of joining maps, for each of the search before it
_PRIOR_S = 4.0  # seconds of the table that count as if they were measured at its speed
_PATCHES_PRIOR_S = 0.5  # seconds of the table of patches that count as if measured at its speed
_MIN_BETWEEN_LINES_S = 20.0  # seconds between lines of the log with the time left
_MAX_SINGLE_RATIO = (4 / 3) ** 2  # of most to least time left, whose mean is a third off at most
_ADJUSTED = re.compile(r"dense(_closer)?|closed|joined|refined\d+")  # maps of all observations
UNDER_LENSES = re.compile(r"(again_)?(lensed\d+|settled(_far)?)")  # stages where two were found


@dataclass(frozen=True, slots=True)
class Size:
    """Size of a run, as far as it is known."""

    frames: float
    megapixels: float  # of a panorama
    trajectory: bool  # True = one of a file
    raw: bool  # True = fisheyes or tracks, not stitched
    lenses: float | None  # 1 = two lenses, 0 = one centre, None = not known yet
    passes: tuple[float, float]  # least and most beyond the first one
    rounds: int  # most rounds of patches
    threads: int
    uncut: bool  # True = raw frames are cut by lenses that nothing has calibrated
    observations: float  # thousands, of the map that patches are aligned for
    more: bool = False  # True = all frames have the keypoints that weak ones get

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> "Size":
        """Size by an event "run"."""
        raw, uncut = bool(entry["raw"]), bool(entry["uncut"])
        return cls(
            frames=float(entry["frames"] or 0),
            megapixels=float(entry["width"]) ** 2 / 2e6,
            trajectory=bool(entry["trajectory"]),
            raw=raw,
            lenses=1.0 if raw else _LENSES[entry["camera"]],
            # least and most beyond the first one, of raw frames that nothing has calibrated
            passes=(1.0, 2.0) if uncut else (0.0, 0.0),
            rounds=int(entry["rounds"]),
            threads=max(int(entry["threads"]), 1),
            uncut=uncut,
            observations=1e-3 * _OBSERVATIONS * float(entry["frames"] or 0),
        )

    def terms(self, phase: int) -> tuple[float, ...]:
        """Regressors of a phase's cost; that of adjusting known points, and of patches, goes by
        their observations, any other by frames."""
        num = self.observations if KNOWN <= phase <= LAST_PATCHES else self.frames
        absent, raw, uncut = num * (not self.trajectory), num * self.raw, num * self.uncut
        pixels = (
            self.frames * self.megapixels,
            # faces and patches are cut no finer from larger panoramas
            self.frames * min(self.megapixels, 1.2),
        )
        more = num * self.more
        return 1.0, num, *pixels, absent, num * (self.lenses or 0.0), raw, uncut, more

    def seconds(self, phase: int) -> float:
        """Expected seconds of a phase at the table's speed."""
        serial, *costs = _COSTS[phase]
        too_late = FIRST_PATCHES + self.rounds <= phase <= LAST_PATCHES
        if too_late or (self.more and phase == WEAK):
            return 0.0
        seconds = sum(cost * term for cost, term in zip(costs, self.terms(phase), strict=True))
        return seconds * (serial + (1 - serial) * 2 / self.threads)  # the table: of two threads


def phase_of(stage: str) -> int | None:
    """Number of the phase that a stage belongs to; None = of none."""
    name = stage.partition("@")[0]
    found = (n for n, phase in enumerate(PHASES) if re.fullmatch(phase, name))
    return next(found, None)


@dataclass(frozen=True, slots=True)
class _Work:
    """Items that a stage works through."""

    name: str
    began: float  # time
    first: int  # items that were done then
    total: int
    at: float  # time of the latest count
    done: int

    def seconds(self, now: float) -> float:
        """Expected seconds from a time on, at the speed so far."""
        done = self.done - self.first
        if done < 0.15 * self.total:  # fewer do not tell how long it takes
            return 0.0
        return max((self.at - self.began) * (self.total - self.done) / done - (now - self.at), 0.0)


class TimeLeft:
    """Expected time to the end of a refinement, from its events.

    Phases that have ended, and the part of one whose items are counted, tell the machine's speed.
    """

    def __init__(self) -> None:
        self._size: Size | None = None
        self._phase, self._phase_began = 0, 0.0
        # Seconds of ended phases and seconds by the table, of all and of rounds of patches.
        self._ended, self._aligned = np.zeros(2), np.zeros(2)
        self._passes = 0
        self._lenses = False  # True = an adjustment under two lenses was seen
        self._whole = True  # False = a stage of this phase was resumed
        self._stage = ""
        self._work: _Work | None = None
        self._search: _Work | None = None  # along epipolar lines
        self._more = False
        self._keyframes = 0
        self._observations: float | None = None  # thousands
        self._tracked: _Work | None = None  # of odometry

    def add(self, entry: Mapping[str, Any]) -> None:
        """Take up an event."""
        kind, now = entry.get("event"), float(entry.get("time") or 0.0)
        if kind in ("start", "end"):
            self.__init__()
        elif kind == "run":
            with suppress(KeyError, TypeError, ValueError):  # of another version's run
                self._size = Size.of(entry)
        elif kind == "features":
            self._more = bool(entry.get("more"))
        elif kind == "keyframe":
            self._keyframes += 1
        elif kind == "map" and _ADJUSTED.fullmatch(str(entry.get("name"))):
            self._observations = 1e-3 * float(entry["observations"])
        elif kind == "stage":
            self._stage, self._work, self._search = str(entry.get("name")), None, None
            self._enter(self._stage, now)
        elif kind == "done":
            self._stage, self._work = "", None
            if entry.get("resumed"):
                self._enter(str(entry.get("name")), now)
                self._whole = False
        elif kind == "progress" and entry.get("total"):
            name, done = str(entry.get("what")), int(entry.get("done") or 0)
            total = int(entry["total"])
            if self._work is None or (name, total) != (self._work.name, self._work.total):
                self._work = _Work(name, now, done, total, now, done)
            self._work = replace(self._work, at=now, done=done)
            if self._phase == FEATURES and self._size is not None:
                self._whole &= total >= self._size.frames  # others are of an earlier call
            if name == _TRACKING:
                self._tracked = self._work
            if name == _SEARCH:
                self._search = self._work

    def seconds(self, now: float) -> tuple[float, float] | None:
        """Least and most seconds from a time on; None = the table does not tell."""
        least, most = (self._seconds(now, is_most) for is_most in (False, True))
        return None if least is None or most is None else (least, most)

    def _seconds(self, now: float, is_most: bool) -> float | None:
        size = self._size
        if size is None:
            return None
        if self._stage == _ODOMETRY or not size.frames:
            return self._seconds_of_odometry(size, now, is_most)
        size = self._known(size, is_most)
        speed, spent = self._speed(size), now - self._phase_began
        work_left = 0.0 if self._work is None else self._work.seconds(now)
        if self._stage == _TOUR:
            left = self._seconds_of_tour(work_left, now, is_most)
            return left and left + speed * self._ahead(size, self._phase + 1, is_most)
        if self._stage and phase_of(self._stage) is None:
            return None
        # Seconds of a round of patches for each of the table, by the rounds that have
        # ended; the machine's `speed` before.
        measured, expected = self._aligned
        pace = (measured + _PATCHES_PRIOR_S * speed) / (expected + _PATCHES_PRIOR_S)
        here = pace if self._phase in _PATCHES else speed
        left = max(here * size.seconds(self._phase) - spent, work_left)
        return left + speed * self._ahead(size, self._phase + 1, is_most, pace / speed)

    @property
    def size(self) -> Size | None:
        """Size by what the phases so far have shown; None = no event has told of it."""
        return None if self._size is None else self._known(self._size)

    def _known(self, size: Size, is_most: bool = False) -> Size:
        """The size by what the phases so far have shown; two lenses that may still be found are if
        `is_most`."""
        size = replace(size, more=self._more)
        if self._observations is not None:
            size = replace(size, observations=self._observations)
        if size.raw:
            return replace(size, uncut=size.uncut and self._passes == 0)
        lenses = float(is_most) if size.lenses is None else size.lenses
        if self._lenses or self._phase > CAMERA:
            lenses = float(self._lenses)
        return replace(size, lenses=lenses)

    def _ahead(self, size: Size, phase: int, is_most: bool, pace: float = 1.0) -> float:
        """Seconds by the table of phases from `phase` on, rounds of patches times `pace`, and of
        further passes; of optional phases if `is_most`."""
        more = max(size.passes[is_most] - self._passes, 0.0)
        again = replace(size, uncut=False)
        left_out = set() if is_most else OPTIONAL
        repeated = range(FEATURES, (LAST_PATCHES if size.raw else CAMERA) + 1)
        ahead, further = (
            sum(
                one.seconds(number) * (pace if number in _PATCHES else 1.0)
                for number in phases
                if number not in left_out
            )
            for one, phases in ((size, range(phase, len(PHASES))), (again, repeated))
        )
        return ahead + more * further

    def _speed(self, size: Size) -> float:
        """Seconds for each of the table."""
        (measured, expected), work = self._ended, self._work
        if work is not None and self._phase == FEATURES:
            measured += work.at - work.began
            expected += size.seconds(FEATURES) * (work.done - work.first) / size.frames
        return (measured + _PRIOR_S) / (expected + _PRIOR_S)

    def _seconds_of_tour(self, work_left: float, now: float, is_most: bool) -> float | None:
        """Seconds of the search along epipolar lines and of joining maps; None = not known."""
        search, joining = self._search, _JOINING[is_most]
        if search is None or search.done < search.total:
            searched = 0.0 if search is None else search.at - search.began + work_left
            return work_left + joining * searched if work_left else None
        return max(joining * (search.at - search.began) - (now - search.at), work_left)

    def _seconds_of_odometry(self, size: Size, now: float, is_most: bool) -> float | None:
        """Seconds of the odometry, and of all that comes after it."""
        work = self._tracked
        if work is None or not work.done or not self._keyframes:
            return None
        keyframes = self._keyframes * work.total / work.done
        frames = 0.5 * keyframes
        size = self._known(size, is_most)
        size = replace(size, frames=frames, observations=1e-3 * _OBSERVATIONS * frames)
        expected = 0.04 * (work.done - work.first)  # seconds for each frame of the video
        speed = (work.at - work.began + _PRIOR_S) / (expected + _PRIOR_S)
        here = work.seconds(now)
        if self._stage == _ODOMETRY:
            gone = now - work.at if work.done == work.total else 0.0
            # thereafter for each keyframe, least and most
            here += max(speed * (0.03, 0.2)[is_most] * keyframes - gone, 0.0)
        return here + speed * self._ahead(size, 0, is_most)

    def _enter(self, stage: str, now: float) -> None:
        """Go on to the phase of a stage; one that ends tells the speed."""
        phase = phase_of(stage)
        if UNDER_LENSES.fullmatch(stage):
            self._lenses = True
        self._whole &= stage != _TOUR  # whose time is none of the phase's
        if phase is None or phase == self._phase or self._size is None:
            return
        if self._whole and self._phase >= FEATURES:
            expected = self._known(self._size).seconds(self._phase)
            self._ended += now - self._phase_began, expected
            if self._phase in _PATCHES:
                self._aligned += now - self._phase_began, expected
        if phase < self._phase and phase <= FEATURES:
            self._passes += self._phase > FEATURES
        self._phase, self._phase_began, self._whole = phase, now, True


class LoggedTimeLeft:
    """Time left as lines of the log, ever less often, and beside progress bars."""

    def __init__(self) -> None:
        self._left, self._began = TimeLeft(), time.time()
        self._due = self._began + _MIN_BETWEEN_LINES_S

    def add(self, entry: Mapping[str, Any]) -> None:
        """Take up an event; see `gsba.log.Follower`."""
        self._left.add(entry)
        now = time.time()
        if now < self._due or entry.get("event") == "log":
            return
        seconds = self._left.seconds(now)
        if seconds is None or seconds[1] < 10.0:  # not worth a line
            return
        self._due = now + max(_MIN_BETWEEN_LINES_S, 0.1 * (now - self._began))
        logger.info("%s left", in_words(seconds))

    def note(self) -> str:
        """Text beside progress bars."""
        seconds = self._left.seconds(time.time())
        return "" if seconds is None else f"{in_words(seconds)} left of the run"


def is_single(seconds: tuple[float, float]) -> bool:
    """True if the mean of least and most seconds is a third off at most."""
    return seconds[1] <= _MAX_SINGLE_RATIO * seconds[0]


def in_words(seconds: tuple[float, float]) -> str:
    """Least and most seconds in words: one duration if `is_single`."""
    least, most = seconds
    if is_single(seconds):
        return f"about {duration(math.sqrt(least * most))}"
    words = [duration(one) for one in seconds]
    numbers, units = zip(*(one.split() for one in words), strict=True)
    return f"{numbers[0] if units[0] == units[1] else words[0]} to {words[1]}"


def duration(seconds: float) -> str:
    """Seconds in words, two digits at most."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 90 * 60 else f"{seconds / 3600:.1f} h"


def tell_size(
    settings: RefineSettings, frames: FrameSet | None, width: int, trajectory: bool
) -> None:
    """Pass on the size of a run; see `TimeLeft`. A run with families that the table does not know
    has none.

    Args:
        frames: None = the odometry of a video has still to choose them.
        width: pixels of a panorama.
        trajectory: True = poses are of a file, not of the images.
    """
    if settings.direct_families():
        return
    formats = () if frames is None else frames.formats
    event(
        "run",
        frames=0 if frames is None else len(frames),
        width=width,
        trajectory=trajectory,
        raw=any(kind.layout == "fisheye" for kind in formats),
        uncut=any(kind.lenses_nominal for kind in formats),
        camera=settings.camera.model,
        rounds=settings.patches.rounds,
        threads=settings.solver.threads(),
    )
