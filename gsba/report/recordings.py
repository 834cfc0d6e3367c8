"""The recordings of a run, for its report: their maps, clocks and times."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsba.report.findings import clock_section
from gsba.trajectory.clock import ClockEstimate
from gsba.types import FrameSet, PoseSource, Reconstruction


def of_recordings(
    frames: FrameSet,
    reconstruction: Reconstruction,
    sources: np.ndarray,
    clocks: Sequence[ClockEstimate | None],
) -> list[dict[str, Any]]:
    """Content of report.json on each of several recordings, in order; [] if there is only one.

    Args:
        frames: frames of the run.
        reconstruction: the result.
        sources: (F,) `PoseSource` of the frames' initial poses.
        clocks: clock of each recording's trajectory; None = not checked.
    """
    found, numbers = [], reconstruction.map_numbers()
    for (name, rows), clock in zip(frames.recordings.items(), clocks, strict=True):
        of_maps = np.bincount(numbers[rows])
        own = {
            "name": name,
            "frames": len(rows),
            "with_trajectory": bool((sources[rows] != PoseSource.NONE).any()),
            "frames_of_maps": {n: count for n, count in enumerate(of_maps.tolist()) if n and count},
            "frames_in_no_map": int(np.count_nonzero(numbers[rows] == 0)),
            "first": float(frames.timestamps[rows[0]]),
            "clock_shift_s": frames.clock_shifts[int(rows[0])],
        }
        found.append(own if clock is None else own | {"clock": clock_section(clock)})
    return found


def notes_on_recordings(recordings: Sequence[dict[str, Any]]) -> list[str]:
    """A sentence on each recording of which no frame is in the exported map."""
    notes = []
    for one in recordings:
        maps = one["frames_of_maps"]
        if 1 in maps:
            continue
        where = "in no map"
        if maps:
            largest = max(maps, key=maps.__getitem__)
            where = f"map {largest} with a world and scale of its own"
        notes.append(
            f"recording {one['name']} is not joined to the exported map: {where}; recordings are "
            "joined where they show the same place"
        )
    return notes
