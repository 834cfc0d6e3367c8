"""Run folder: results of stages stored under keys, resumed, never half-written.

Takes a stage's computation and all its inputs.
Gives the stored result if no input has changed; a finished run, read back.
"""

from gsba.store.finished import load_run
from gsba.store.folder import claim, is_run_folder
from gsba.store.records import RecordError, load_record, save_record
from gsba.store.store import Chain, PerFrame, RunStore, StageRecord, digest, fingerprint, load_stage

__all__ = [
    "Chain",
    "PerFrame",
    "RecordError",
    "RunStore",
    "StageRecord",
    "claim",
    "digest",
    "fingerprint",
    "is_run_folder",
    "load_record",
    "load_run",
    "load_stage",
    "save_record",
]
