"""Jobs in parts: the same content has the same name, and travels whole."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from shard_jobs import Squares

from gsba.log import GsbaError
from gsba.store import shards
from gsba.store.shards import Threads, blocks_of_frames, even_blocks


def _job(tmp_path: Path, numbers: np.ndarray) -> Squares:
    return Squares(numbers, tmp_path / "log")


def _named(job: Squares, folder: Path) -> Path:
    return shards.write_shard(job, folder)[0]


class _Planted:
    """What leaves a file behind where it is unpickled."""

    def __init__(self, at: Path) -> None:
        self.at = at

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.at,)


def test_a_part_is_named_after_its_content(tmp_path: Path) -> None:
    numbers = np.arange(10.0)
    path = _named(_job(tmp_path, numbers), tmp_path)
    strided = np.arange(20.0).reshape(10, 2)[:, 0] / 2
    assert _named(_job(tmp_path, strided), tmp_path) == path
    assert _named(_job(tmp_path, numbers + 1), tmp_path) != path
    assert _named(_job(tmp_path, numbers.astype(np.float32)), tmp_path) != path
    text = "".join(["squ", "ares"])  # equal, and another object
    other = dataclasses.replace(_job(tmp_path, numbers), mishap=text, title=text)
    same = dataclasses.replace(_job(tmp_path, numbers), mishap="squares", title="squares")
    paths = {_named(job, tmp_path) for job in (other, same)}
    assert len(paths) == 1


def test_a_shard_travels_by_its_files(tmp_path: Path) -> None:
    job = _job(tmp_path, np.arange(5)).part(1, 4)
    path, digest = shards.write_shard(job, tmp_path)
    assert shards.load_shard(path, np.ndarray) is None
    manifest = shards.run_shard(str(path), digest)
    found = shards.load_shard(path, np.ndarray)
    assert found is not None and [int(one[0]) for one in found] == [1, 4, 9]
    assert manifest.cpu_seconds >= 0 and ":" in manifest.worker
    shards.result_path(path).write_bytes(b"half")
    assert shards.load_shard(path, np.ndarray) is None


def test_what_a_worker_cannot_use_is_said(tmp_path: Path, monkeypatch) -> None:
    path, digest = shards.write_shard(_job(tmp_path, np.arange(5)), tmp_path)
    monkeypatch.setattr(shards, "__version__", "0.0.7")
    refused(r"has gsba 0\.0\.7, the run has", shards.run_shard, str(path), digest)
    with pytest.raises(GsbaError, match=r"does not see .*gone\.job: put the run on a shared disk"):
        shards.run_shard(str(tmp_path / "gone.job"), digest)


def test_no_job_runs_but_what_the_caller_wrote(tmp_path: Path) -> None:
    """A folder of shards may be a stranger's: what lies there under a right name is not right."""
    mark, job = tmp_path / "mark", _job(tmp_path, np.arange(5))
    path, digest = shards.write_shard(job, tmp_path)
    wanted = path.read_bytes()
    planted = shards.__version__.encode() + b"\n" + pickle.dumps(_Planted(mark))
    pickle.loads(planted.partition(b"\n")[2])
    assert mark.exists()  # the plant works
    mark.unlink()
    path.write_bytes(planted)
    refused(r"\.job was changed after this run wrote it", shards.run_shard, str(path), digest)
    assert not mark.exists()
    assert shards.write_shard(job, tmp_path) == (path, digest)  # replaces it
    assert path.read_bytes() == wanted
    shards.run_shard(str(path), digest)
    assert not mark.exists()


def test_blocks_cover_all_items_in_order() -> None:
    frames = np.array([0, 0, 5, 31, 32, 40, 200, 200])
    assert blocks_of_frames(frames) == [(0, 4), (4, 6), (6, 8)]
    assert blocks_of_frames(np.zeros(0, int)) == []
    assert blocks_of_frames(np.zeros(600, int)) == [(0, 256), (256, 512), (512, 600)]
    assert even_blocks(70) == [(0, 32), (32, 64), (64, 70)]
    assert even_blocks(0) == []


def test_threads_give_results_in_order_and_stop_at_an_error(tmp_path: Path) -> None:
    job = _job(tmp_path, np.arange(50))
    found = [int(one[0]) for one in Threads(3).map_shards(job)]
    assert found == [n * n for n in range(50)]
    broken = _job(tmp_path / "no", np.arange(50))
    with pytest.raises(FileNotFoundError):
        list(Threads(3).map_shards(broken))
