"""The same input gives the same bytes: with any number of threads, kernels compiled or cached."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_run import SETTINGS, Case

import gsba

pytestmark = pytest.mark.slow

_OUTPUTS = ("trajectory.tum", "poses.csv", "points.ply")
_REFINE = """
import sys
from pathlib import Path
from gsba import pipeline
from gsba.config import RefineSettings
settings, frames, slam, out = sys.argv[1:]
settings = RefineSettings.model_validate_json(settings)
pipeline.refine(Path(frames), Path(slam), Path(out), settings)
"""


def _outputs(out: Path) -> dict[str, bytes]:
    return {name: (out / name).read_bytes() for name in _OUTPUTS}


def test_threads_change_nothing(case: Case, tmp_path: Path) -> None:
    runs = [tmp_path / str(num_threads) for num_threads in (1, 4)]
    for out in runs:
        solver = SETTINGS.solver.model_copy(update={"num_threads": int(out.name)})
        changes = {"factors": ("bearing", "photometric"), "solver": solver}
        case.refine(out, SETTINGS.model_copy(update=changes))
    assert _outputs(runs[0]) == _outputs(runs[1])


def test_compiling_kernels_changes_nothing(case: Case, tmp_path: Path) -> None:
    path, cache = str(Path(gsba.__file__).parents[1]), tmp_path / "kernels"
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(cache)}
    runs = [tmp_path / name for name in ("compiled", "cached")]
    for out in runs:
        assert any(cache.rglob("*.kernel")) == (out.name == "cached")
        words = [SETTINGS.model_dump_json(), case.frames, case.slam, out]
        call = [sys.executable, "-c", _REFINE, *map(str, words)]
        subprocess.run(call, env=environment, check=True)
    assert _outputs(runs[0]) == _outputs(runs[1])
