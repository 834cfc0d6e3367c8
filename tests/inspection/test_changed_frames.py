"""Frames that are no longer those of a run."""

from dataclasses import replace

import numpy as np
import pytest
from command import fails, run_gsba
from refusals import refused
from tiny_run import Case

from gsba.inspection.changed_frames import refuse_changed_frames
from gsba.store.finished import load_run


def test_other_pictures_of_the_same_names_are_refused(case: Case) -> None:
    found, frames = load_run(case.out)
    refuse_changed_frames(case.out, found, frames)
    half = len(frames) // 2
    others = replace(frames, paths=frames.paths[half:] + frames.paths[:half])
    message = "and other frames are no longer what .* was made of: their colours are not"
    refused(message, refuse_changed_frames, case.out, found, others)


def test_a_run_is_checked_before_a_recording_is_taken_out(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the frames that are left alone: those of the recording may be gone."""
    found, frames = load_run(case.out)
    num, removed = len(frames), list[object]()
    half = num // 2
    names = [f"{'a' if f < half else 'b'}/{f}" for f in range(num)]
    others = replace(
        frames,
        names=tuple(names),
        clock_shifts=tuple(np.arange(num) // half * 10.0),
        paths=frames.paths[half:] + frames.paths[half:],  # a's are others
    )
    monkeypatch.setattr("gsba.store.finished.load_run", lambda _: (found, others))
    monkeypatch.setattr("gsba.pipeline.remove_recordings", lambda *given: removed.append(given))
    monkeypatch.setattr("gsba.cli.growing.conclude", lambda *_: None)
    fails(run_gsba("remove", case.out, "b"), "are no longer what")
    assert not removed
    assert run_gsba("remove", case.out, "a").exit_code == 0 and len(removed) == 1
