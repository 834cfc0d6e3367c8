"""A run's folder: results of stages under their keys, resumed, never half-written.

Takes what a stage computes and all it depends on.
Gives the stored result where that has not changed; a finished run, read back.
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
