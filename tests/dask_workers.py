"""Workers of a Dask scheduler, as tests start them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from distributed import Client


@contextmanager
def some_workers(num: int = 2, **settings: object) -> Iterator["Client"]:
    """A client of worker processes of one thread each, under settings of Dask (`__` for a dot)."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set({key.replace("__", "."): value for key, value in settings.items()}):
        cluster = LocalCluster(
            n_workers=num, threads_per_worker=1, dashboard_address=":0", silence_logs=50
        )
        try:
            with Client(cluster) as client:
                yield client
        finally:
            with suppress(TimeoutError):  # workers that restart may not answer
                cluster.close(timeout=60)
