"""Run folder: results of stages stored under keys, resumed, never half-written.

Takes a stage's computation and all its inputs.
Gives the stored result if no input has changed; a finished run, read back.
"""

from gsba.store.finished import load_run
from gsba.store.store import RunStore

__all__ = ["RunStore", "load_run"]
