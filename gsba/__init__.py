"""gsba: pixel-true camera poses for 360-degree video.

The public names below are imported on first use, so that `import gsba` is fast. Every room of the
package lists its own names: `from gsba.export import export`, `from gsba.evaluate import evaluate`.
docs/architecture.md lists all rooms.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsba.version import __version__ as __version__

if TYPE_CHECKING:
    from gsba.bundle.families import Family, MapSnapshot, PointObservations
    from gsba.bundle.optimizer import optimize
    from gsba.bundle.pose_variables import X
    from gsba.config import RefineSettings
    from gsba.config_file import load_config
    from gsba.localization.localizer import LocalizedFrame, Localizer
    from gsba.log import GsbaError
    from gsba.pipeline.growing import add_recordings, merge_runs, remove_recordings
    from gsba.pipeline.outputs import RunResult
    from gsba.pipeline.recordings import Recording
    from gsba.pipeline.refine import refine, refine_recordings
    from gsba.store.finished import load_run

__all__ = [
    "Family",
    "GsbaError",
    "LocalizedFrame",
    "Localizer",
    "MapSnapshot",
    "PointObservations",
    "Recording",
    "RefineSettings",
    "RunResult",
    "X",
    "add_recordings",
    "load_config",
    "load_run",
    "merge_runs",
    "optimize",
    "refine",
    "refine_recordings",
    "remove_recordings",
]

_HOMES = {
    "Family": "gsba.bundle.families",
    "GsbaError": "gsba.log",
    "LocalizedFrame": "gsba.localization.localizer",
    "Localizer": "gsba.localization.localizer",
    "MapSnapshot": "gsba.bundle.families",
    "PointObservations": "gsba.bundle.families",
    "Recording": "gsba.pipeline.recordings",
    "RefineSettings": "gsba.config",
    "RunResult": "gsba.pipeline.outputs",
    "X": "gsba.bundle.pose_variables",
    "add_recordings": "gsba.pipeline.growing",
    "load_config": "gsba.config_file",
    "load_run": "gsba.store.finished",
    "merge_runs": "gsba.pipeline.growing",
    "optimize": "gsba.bundle.optimizer",
    "refine": "gsba.pipeline.refine",
    "refine_recordings": "gsba.pipeline.refine",
    "remove_recordings": "gsba.pipeline.growing",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gsba' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def _require_our_factors() -> None:
    """Raise ImportError if `factors` is another distribution's package, without importing it."""
    spec = find_spec("factors")
    origin = spec.origin if spec else None
    if origin is None or "LandmarkBlock" not in Path(origin).read_text(encoding="utf-8"):
        raise ImportError(
            f"gsba needs its own package 'factors', but Python finds {origin or 'none'}: "
            "install gsba into a fresh virtual environment, without another 'factors'"
        )


_require_our_factors()
