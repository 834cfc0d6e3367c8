"""Pictures of exports written by worker processes: the same files, whatever befalls them."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap
import pytest
from command import run_gsba
from dask_workers import some_workers
from export_scene import NUM_FRAMES, contents, panoramas, reconstruction
from shard_jobs import DiesWriting
from tiny_run import Case

from gsba.camera.cameras import Cameras
from gsba.export import ExportFormat, ExportOptions, export_all, formats, images, pictures
from gsba.export.dataset import Dataset
from gsba.log import GsbaError
from gsba.placement.placement import Placement
from gsba.store.cluster import hired
from gsba.store.shards import even_blocks

if TYPE_CHECKING:
    from distributed import Client

pytest.importorskip("distributed", reason="needs the extra cluster")

pytestmark = pytest.mark.slow

FORMATS = [ExportFormat.COLMAP, ExportFormat.COLMAP_ERP]


@pytest.fixture(scope="module")
def client() -> Iterator["Client"]:
    with some_workers() as client:
        yield client


def test_killed_workers_leave_no_trace(client, tmp_path: Path, monkeypatch) -> None:
    frames = panoramas(tmp_path / "frames", ".jpg", masked=True)
    here, there = ({to: tmp_path / who / to for to in FORMATS} for who in ("here", "there"))
    export_all(reconstruction(), frames, here)

    def with_mishap(frames, writers, workers) -> None:
        first = DiesWriting(writers[0][0].files, frames.names[4])
        images.write_pictures(frames, [[first], *writers], workers)

    monkeypatch.setattr(formats, "write_pictures", with_mishap)
    monkeypatch.setattr(pictures, "even_blocks", lambda num: even_blocks(num, 2))
    with hired(client, tmp_path / "there" / "any", frames) as workers:
        export_all(reconstruction(), frames, there, workers=workers)
        spent = workers.spent()
    assert (tmp_path / "there" / "died").exists()
    (tmp_path / "there" / "died").unlink()
    assert sum(spent.shards.values()) == 5 and spent.cpu_seconds > 0
    assert contents(tmp_path / "here") == contents(tmp_path / "there")
    model = pycolmap.Reconstruction(there[ExportFormat.COLMAP] / "sparse/0")
    assert model.num_images() == 6 * NUM_FRAMES
    for image in model.images.values():
        shown = pycolmap.Bitmap.read(there[ExportFormat.COLMAP] / "images" / image.name, True)
        camera = model.cameras[image.camera_id]
        assert shown is not None and (shown.width, shown.height) == (camera.width, camera.height)


def test_a_dataset_that_workers_do_not_see_is_named(client, tmp_path: Path, monkeypatch) -> None:
    frames = panoramas(tmp_path / "frames", ".jpg")
    monkeypatch.setattr(pictures.Files, "make_folders", lambda files, _: files.folder.rmdir())
    files = pictures.Files(tmp_path / "unseen", ("",), "{name}{suffix}", "")
    files.folder.mkdir()
    given = files.folder, reconstruction(), frames, Cameras(), ExportFormat.TUM, "panorama"
    data = Dataset(*given, Placement(), ExportOptions())
    writers = images.panorama_writers(data, files)
    with (
        hired(client, tmp_path / "out", frames) as workers,
        pytest.raises(GsbaError, match=f"does not see {tmp_path}/unseen: put it on a disk"),
    ):
        images.write_pictures(frames, [writers], workers)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames"]


def test_a_finished_run_is_exported_by_workers(case: Case, client, tmp_path: Path) -> None:
    address = client.scheduler.address
    for out, more in (("here", ()), ("there", ("--cluster", address))):
        arguments = ["export", case.out, "--to", "nerfstudio", "--out", tmp_path / out, *more]
        assert run_gsba(*arguments).exit_code == 0
    assert contents(tmp_path / "here") == contents(tmp_path / "there")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here", "there"]
