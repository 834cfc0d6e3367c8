"""Workers of a Dask scheduler: real processes, and what goes wrong with them."""

import json
import sys
import types
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from dask_workers import some_workers
from refusals import refused
from shard_jobs import Squares
from tiny_run import Case

from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.store import cluster as workers
from gsba.store.cluster import Cluster, connect, connected
from gsba.store.shards import Threads
from gsba.store.store import RunStore

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def client() -> Iterator["distributed.Client"]:
    with some_workers() as client:
        yield client


def _squares(folder: Path, mishap: str = "", at: int = -1, num: int = 9) -> Squares:
    return Squares(np.arange(num), folder / "log", mishap, at)


def _cluster(client: "distributed.Client", folder: Path) -> Cluster:
    return Cluster(client, folder / "shards", folder)


def _assert_squares(found: list[np.ndarray], num: int = 9) -> None:
    assert [int(one[0]) for one in found] == [n * n for n in range(num)]


def test_results_come_in_order_and_leave_their_cost(client, tmp_path: Path) -> None:
    job, cluster = _squares(tmp_path), _cluster(client, tmp_path)
    found = list(cluster.map_shards(job))
    here = list(Threads(2).map_shards(_squares(tmp_path)))
    for one, other in zip(found, here, strict=True):
        np.testing.assert_array_equal(one, other)
    spent = cluster.spent()
    assert sum(spent.shards.values()) == 5 and spent.cpu_seconds > 0
    assert not list(cluster.map_shards(_squares(tmp_path, num=0)))


def test_a_run_is_the_same_to_the_byte(case: Case, client, tmp_path: Path) -> None:
    """All stages that are shared out, with people to be masked; and nothing is left behind."""
    case.refine(tmp_path / "here", masks="distractors")
    case.refine(tmp_path / "there", masks="distractors", client=client)
    model = ["sparse/0/images.bin", "images/front/000003.jpg", "masks/up/000007.jpg.png"]
    for name in ("trajectory.tum", "poses.csv", "points.ply", *(f"colmap/{n}" for n in model)):
        here, there = ((tmp_path / run / name).read_bytes() for run in ("here", "there"))
        assert here == there, name
    assert not list((tmp_path / "there" / "stages" / "shards").glob("*"))
    stages = json.loads((tmp_path / "there" / "report.json").read_text())["stages"]
    shared = {stage["name"].rstrip("12") for stage in stages if stage["workers"]}
    assert shared >= {"features", "neighbours", "adjacent", "near", "align", "distractors"}
    assert "export-colmap" in shared


@pytest.mark.parametrize("mishap", ["dies", "dies_while_writing"])
def test_killed_workers_cost_time_alone(client, tmp_path: Path, mishap: str) -> None:
    job = _squares(tmp_path, mishap, 4)
    _assert_squares(list(_cluster(client, tmp_path).map_shards(job)))
    assert len(job.done()) > 9  # something was done again
    assert (tmp_path / f"log.{mishap}").exists()


def test_a_worker_lost_from_sight_is_replaced(tmp_path: Path) -> None:
    """Compiled code that holds the interpreter's lock keeps it from answering."""
    job = _squares(tmp_path, "keeps_the_lock", 4)
    with some_workers(distributed__scheduler__worker_ttl="2s") as client:
        _assert_squares(list(_cluster(client, tmp_path).map_shards(job)))


def test_a_late_shard_is_given_to_another_worker(client, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "_MIN_LATE_S", 1.0)
    monkeypatch.setattr(workers, "_POLL_S", 0.2)
    job = _squares(tmp_path, "is_slow", 4)
    _assert_squares(list(_cluster(client, tmp_path).map_shards(job)))
    assert job.done().count(4) >= 2


def test_a_shard_that_kills_every_worker_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "_MAX_ATTEMPTS", 2)
    job = Squares(np.arange(9), tmp_path / "log", "always dies", 4)
    with (
        some_workers(distributed__scheduler__allowed_failures=0) as client,
        pytest.raises(GsbaError, match="2 workers died on squares, 4 to 5"),
    ):
        list(_cluster(client, tmp_path).map_shards(job))


def test_workers_do_not_pause_for_memory(tmp_path: Path) -> None:
    """One that does would wait for ever: compiled code and caches do not give it back."""
    with some_workers(1, distributed__worker__memory__pause=0.001) as client:
        _assert_squares(list(_cluster(client, tmp_path).map_shards(_squares(tmp_path))))


def test_a_disk_that_refuses_is_said_and_the_rest_is_kept(tmp_path: Path) -> None:
    job = _squares(tmp_path, "finds_no_space", 4)
    with (
        some_workers(1) as client,
        pytest.raises(GsbaError, match=r"cannot write .*shards.*File too large"),
    ):
        list(_cluster(client, tmp_path).map_shards(job))
    assert not list(tmp_path.rglob(".gsba-tmp-*"))
    before = job.done()
    with some_workers(1) as client:
        _assert_squares(list(_cluster(client, tmp_path).map_shards(job)))
    again = job.done()
    assert again.count(0) == before.count(0) == 1  # finished before, not done again


def test_an_interrupted_job_goes_on_from_finished_shards(client, tmp_path: Path) -> None:
    job = _squares(tmp_path, num=40)
    with closing(_cluster(client, tmp_path)._results(job)) as results:
        for _ in range(21):
            next(results)
    finished = {int(p.stem, 16) for p in (tmp_path / "shards").glob("[!.]*.npz")}
    assert len(finished) >= 11
    _assert_squares(list(_cluster(client, tmp_path).map_shards(job)), 40)
    assert all(job.done().count(n) == 1 for n in range(21))


def test_a_worker_that_asks_for_others_does_not_wait_for_itself(tmp_path: Path) -> None:
    """`refine` within a task, on the only worker there is."""

    def nested(folder: str) -> list[int]:
        from pathlib import Path

        from distributed import get_client
        from shard_jobs import Squares

        from gsba.store.cluster import Cluster

        job = Squares(np.arange(9), Path(folder) / "log")
        cluster = Cluster(get_client(), Path(folder) / "shards", Path(folder))
        return [int(one[0]) for one in cluster.map_shards(job)]

    with some_workers(1) as client:
        assert client.submit(nested, str(tmp_path)).result(60) == [n * n for n in range(9)]


def test_other_versions_are_refused_with_both(client, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "__version__", "0.0.7")
    refused(r"worker tcp://.* has gsba [\d.]+.*, this machine 0\.0\.7", _cluster, client, tmp_path)


def test_a_folder_that_workers_do_not_see_is_named(client, tmp_path: Path) -> None:
    with pytest.raises(GsbaError, match=f"does not see {tmp_path}/elsewhere: put it on a disk"):
        Cluster(client, tmp_path / "shards", tmp_path / "elsewhere")


def test_workers_are_started_and_let_go(tmp_path: Path) -> None:
    """`--cluster local:1`; a stage says how many workers took part."""
    job = _squares(tmp_path)
    with connected(None) as nobody:
        assert nobody is None
    with connected("local:1") as client:
        hire = workers.hire(client, tmp_path, RefineSettings())
        with RunStore(tmp_path / "run", {"frames": tmp_path}, hire=hire) as store:

            def compute() -> np.ndarray:
                return np.stack(list(store.workers.map_shards(job)))

            assert store.stage("squares", None, compute, np.ndarray).shape == (9, 1000)
            assert store.records["squares"].workers == 1
        assert not list((tmp_path / "run/stages/shards").glob("*"))
    assert client is not None and client.status == "closed"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:9", "no scheduler answers there"),
        ("nowhere", r"no scheduler answers there \(no address .*\); pass tcp://HOST:PORT"),
        ("tls://", "no address of the form tcp://HOST:PORT"),
        ("tls://127.0.0.1:9", "no scheduler answers there"),
        ("tcp://127.0.0.1:99999", "no scheduler answers there"),
        ("tcp://127.0.0.1:x", "no scheduler answers there"),
        ("nobody://127.0.0.1:9", "no address of the form tcp://HOST:PORT"),
        ("{folder}/missing.json", r"missing\.json: no scheduler answers there \(.*No such file"),
        ("{folder}/empty.json", r"empty\.json: no scheduler answers there \(no address"),
        ("{folder}/list.json", r"list\.json: no scheduler answers there"),
        ("{folder}/text.json", r"text\.json: no scheduler answers there"),
        ("local:many", "give the number of workers, 1 to 256, as in local:8"),
        ("local:1000000000", "give the number of workers, 1 to 256, as in local:8"),
        ("slurm:0", "give the number of workers, 1 to 100000, as in slurm:8"),
        ("oar:4", "needs dask-jobqueue: pip install dask-jobqueue"),
    ],
)
def test_addresses_that_lead_nowhere(
    address: str, message: str, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(workers, "_SCHEDULER_TIMEOUT_S", 0.5)
    monkeypatch.setitem(sys.modules, "dask_jobqueue", None)
    for name, content in (("empty", "{}"), ("list", "[" * 100_000), ("text", "\udcff")):
        (tmp_path / f"{name}.json").write_text(content, errors="surrogateescape")
    refused(message, connect, address.format(folder=tmp_path))


def test_queues_are_configured_by_dask_and_asked_for_workers(monkeypatch) -> None:
    asked = []

    class SLURMCluster(distributed.LocalCluster):
        def __init__(self) -> None:
            super().__init__(n_workers=0, dashboard_address=":0")

        def scale(self, n: int) -> None:
            asked.append(n)

    module = types.ModuleType("dask_jobqueue")
    monkeypatch.setattr(module, "SLURMCluster", SLURMCluster, raising=False)
    monkeypatch.setitem(sys.modules, "dask_jobqueue", module)
    with connect("slurm:12") as client:
        assert client.status == "running"
    assert asked == [12]
    client.cluster.close()
