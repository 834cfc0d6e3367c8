"""A map solved in parts: beside the undivided one, stopped and resumed, on workers that die."""

import errno
import os
import signal
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from dask_workers import some_workers
from gtsam.symbol_shorthand import X
from refusals import refused
from town_in_parts import NUM, town, write

from factors import LandmarkBlock, RobustLoss
from gsba import disk
from gsba.bundle.optimizer import OptimizeResult, SolverOptions, optimize
from gsba.disk import FullDiskError
from gsba.log import GsbaError
from gsba.parts import folder as parts_folder
from gsba.parts.divided_system import SolverState, optimize_divided
from gsba.parts.folder import PartsWriter, load, load_index, load_part, values_at
from gsba.parts.jobs import PartPoints, version_file
from gsba.store.cluster import Cluster
from gsba.store.shards import Job, Spent, Threads

LOSS = RobustLoss("cauchy", 2.0)
SETTINGS = SolverOptions(
    relative_tolerance=1e-10, absolute_tolerance=None, loss=LOSS, lambda_initial=1e-2
)


def poses_of(values: gtsam.Values) -> np.ndarray:
    """Poses (F, 4, 4) of a result."""
    return np.array([values.atPose3(X(f)).matrix() for f in range(NUM)])


@pytest.fixture(scope="module")
def undivided() -> tuple[OptimizeResult, np.ndarray]:
    """The town solved by one system of all frames; its landmarks."""
    points, term, rows, graph = town()
    keys = [X(f) for f in range(NUM)]
    block = LandmarkBlock(keys, points, [term], LOSS, num_threads=1)
    result = optimize(graph, values_at(np.arange(NUM), rows), [block], SETTINGS)
    return result, block.points_world


@pytest.fixture(scope="module")
def divided(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Poses of the town solved in parts without any mishap."""
    folder = tmp_path_factory.mktemp("town") / "map"
    write(folder, 15)
    return poses_of(optimize_divided(folder, Threads(1), SETTINGS).values)


@pytest.mark.parametrize("most", [8, 40, NUM])
def test_parts_give_the_undivided_result(most: int, undivided, tmp_path: Path) -> None:
    write(tmp_path / "map", most)
    index = load_index(tmp_path / "map")
    assert (len(index.num_kept) > 1) == (most < NUM)
    found = optimize_divided(tmp_path / "map", Threads(1), SETTINGS)
    expected, points = undivided
    assert found.reason == expected.reason
    assert [s.accepted for s in found.history] == [s.accepted for s in expected.history]
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    assert found.history[-1].costs.keys() == expected.history[-1].costs.keys()
    np.testing.assert_allclose(poses_of(found.values), poses_of(expected.values), atol=1e-9)
    for number in range(len(index.num_kept)):
        part = load_part(tmp_path / "map", number)
        version = load(tmp_path / "map" / "result.npz", SolverState).version
        file = version_file(tmp_path / "map", number, "points", version)
        moved, seen = load(file, PartPoints).points_world, np.unique(part.sightings.points)
        off = np.abs(moved - points[part.numbers])[seen].max(axis=1)
        assert np.median(off) < 1e-9 and off.max() < 1e-5  # a few are almost free along a ray


def test_every_observation_and_factor_is_owned_once(tmp_path: Path) -> None:
    write(tmp_path / "map", 15)
    points, term, _, graph = town()
    parts = [
        load_part(tmp_path / "map", p) for p in range(len(load_index(tmp_path / "map").num_kept))
    ]
    numbers = np.concatenate([part.numbers for part in parts])
    assert sorted(numbers) == list(range(len(points)))
    seen = {
        (frame, point)
        for part in parts
        for frame, point in zip(
            part.frames[part.sightings.frames], part.numbers[part.sightings.points], strict=True
        )
    }
    assert seen == set(zip(term.frames.tolist(), term.points.tolist(), strict=True))
    assert sum(parts_folder.deserialized(part.graph).size() for part in parts) == graph.size()


class Failing:
    """Threads of this process that fail at the n-th result."""

    num_threads = 1

    def __init__(self, at: int, error: BaseException) -> None:
        self._left, self._error = at, error

    def map_shards(self, job: Job[Any]) -> Iterator[Any]:
        """See `gsba.store.shards.Workers`."""
        for result in Threads(1).map_shards(job):
            self._left -= 1
            if self._left < 0:
                raise self._error
            yield result

    def spent(self) -> Spent:
        """See `gsba.store.shards.Workers`."""
        return Spent()

    def at_most(self, num: int) -> "Failing":
        """See `gsba.store.shards.Workers`."""
        return self

    def must_see(self, paths: object) -> None:
        """See `gsba.store.shards.Workers`."""


def test_a_call_goes_on_where_earlier_ones_were_stopped(divided, tmp_path: Path) -> None:
    write(tmp_path / "map", 15)
    for at in (0, 9, 31, 61):
        with pytest.raises(KeyboardInterrupt):
            optimize_divided(tmp_path / "map", Failing(at, KeyboardInterrupt()), SETTINGS)
    found = optimize_divided(tmp_path / "map", Threads(1), SETTINGS)
    np.testing.assert_array_equal(poses_of(found.values), divided)
    again = optimize_divided(tmp_path / "map", Threads(1), SETTINGS)  # from its last step
    np.testing.assert_array_equal(poses_of(again.values), divided)


def test_the_iteration_limit_is_that_of_all_calls_together(tmp_path: Path) -> None:
    few = replace(SETTINGS, max_iterations=3)
    write(tmp_path / "map", 15)
    write(tmp_path / "stopped", 15)
    undisturbed = optimize_divided(tmp_path / "map", Threads(1), few)
    assert undisturbed.reason == "iteration limit"
    with pytest.raises(KeyboardInterrupt):
        optimize_divided(tmp_path / "stopped", Failing(31, KeyboardInterrupt()), few)
    found = optimize_divided(tmp_path / "stopped", Threads(1), few)
    np.testing.assert_array_equal(poses_of(found.values), poses_of(undisturbed.values))


def test_a_full_disk_ends_in_one_line_and_costs_nothing_else(
    divided, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "map", 15)
    replace: Callable[..., None] = os.replace
    left = [60]

    def full(*args: Any, **options: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(*args, **options)

    with monkeypatch.context() as patched:
        patched.setattr(disk.os, "replace", full)
        with pytest.raises(FullDiskError) as caught:
            optimize_divided(tmp_path / "map", Threads(1), SETTINGS)
        assert len(str(caught.value).splitlines()) == 1
    found = optimize_divided(tmp_path / "map", Threads(1), SETTINGS)
    np.testing.assert_array_equal(poses_of(found.values), divided)


def test_damaged_and_foreign_folders_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "map", 15)
    refused("holds the parts of a map", PartsWriter, tmp_path / "map")
    given = tmp_path / "map/part-00001/given.npz"
    given.write_bytes(given.read_bytes()[:2000])
    refused("the parts of this map again", optimize_divided, tmp_path / "map", Threads(1), SETTINGS)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/one.jpg").touch()
    refused("is not empty", PartsWriter, tmp_path / "photos")
    assert (tmp_path / "photos/one.jpg").exists()


def test_a_writer_starts_anew_where_one_was_interrupted(tmp_path: Path) -> None:
    points, term, *_ = town(1)
    PartsWriter(tmp_path / "map").add(points, [term])
    written = []
    for folder in (tmp_path / "map", tmp_path / "fresh"):
        write(folder, 15)
        files = [path for path in folder.rglob("*") if path.is_file()]
        written.append({path.relative_to(folder): _members(path) for path in files})
    assert written[0] == written[1] and len(written[0]) > 6


def _members(path: Path) -> dict[str, bytes]:
    """Content of a record, whose file tells when it was written, too."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_factors_written_in_python_are_refused(tmp_path: Path) -> None:
    points, term, *_ = town()
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Unit.Create(1)
    graph.add(gtsam.CustomFactor(noise, [X(0)], lambda factor, values, jacobians: np.zeros(1)))
    with pytest.raises(GsbaError, match="written in Python cannot be stored"):
        PartsWriter(tmp_path / "map").add(points, [term], graph)


@pytest.mark.slow
@pytest.mark.parametrize("num", [1, 2])
def test_workers_give_the_same_bytes_even_if_they_are_killed(
    num: int, divided, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="needs the extra cluster")
    write(tmp_path / "map", 15)
    scratch = tmp_path / "shards"
    scratch.mkdir()
    killed: list[int] = []
    with some_workers(num, distributed__scheduler__allowed_failures=10) as started:
        client: Any = started  # its methods are typed as coroutines
        client.wait_for_workers(num)
        ended = threading.Event()

        def kill() -> None:
            for _ in range(3):
                if ended.wait(2.0):
                    return
                for pid in list(client.run(os.getpid).values())[:1]:
                    os.kill(pid, signal.SIGKILL)
                    killed.append(pid)

        killer = threading.Thread(target=kill, daemon=True)
        killer.start()
        workers = Cluster(client, scratch, tmp_path)
        found = optimize_divided(tmp_path / "map", workers, SETTINGS, scratch)
        ended.set()
        killer.join()
    np.testing.assert_array_equal(poses_of(found.values), divided)
    assert killed and not list(scratch.iterdir())
