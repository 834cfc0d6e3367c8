"""Jobs in parts: the same content has the same name, and travels whole."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from shard_jobs import Squares

from gsba.log import GsbaError
from gsba.store import shards
from gsba.store.shards import Threads, blocks_of_frames, even_blocks


def _job(tmp_path: Path, numbers: np.ndarray) -> Squares:
    return Squares(numbers, tmp_path / "log")


def test_a_part_is_named_after_its_content(tmp_path: Path) -> None:
    numbers = np.arange(10.0)
    path = shards.write_shard(_job(tmp_path, numbers), tmp_path)
    strided = np.arange(20.0).reshape(10, 2)[:, 0] / 2
    assert shards.write_shard(_job(tmp_path, strided), tmp_path) == path
    assert shards.write_shard(_job(tmp_path, numbers + 1), tmp_path) != path
    assert shards.write_shard(_job(tmp_path, numbers.astype(np.float32)), tmp_path) != path
    text = "".join(["squ", "ares"])  # equal, and another object
    other = dataclasses.replace(_job(tmp_path, numbers), mishap=text, title=text)
    same = dataclasses.replace(_job(tmp_path, numbers), mishap="squares", title="squares")
    paths = {shards.write_shard(job, tmp_path) for job in (other, same)}
    assert len(paths) == 1


def test_a_shard_travels_by_its_files(tmp_path: Path) -> None:
    job = _job(tmp_path, np.arange(5)).part(1, 4)
    path = shards.write_shard(job, tmp_path)
    assert shards.load_shard(path, np.ndarray) is None
    manifest = shards.run_shard(str(path))
    found = shards.load_shard(path, np.ndarray)
    assert found is not None and [int(one[0]) for one in found] == [1, 4, 9]
    assert manifest.cpu_seconds >= 0 and ":" in manifest.worker
    shards.result_path(path).write_bytes(b"half")
    assert shards.load_shard(path, np.ndarray) is None


def test_what_a_worker_cannot_use_is_said(tmp_path: Path, monkeypatch) -> None:
    path = shards.write_shard(_job(tmp_path, np.arange(5)), tmp_path)
    monkeypatch.setattr(shards, "__version__", "0.0.7")
    with pytest.raises(GsbaError, match=r"has gsba 0\.0\.7, the run has"):
        shards.run_shard(str(path))
    with pytest.raises(GsbaError, match=r"does not see .*gone\.job: put the run on a shared disk"):
        shards.run_shard(str(tmp_path / "gone.job"))


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
