"""Frames that are no longer those of a run."""

from dataclasses import replace

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
