"""The run folder: round trips, resume, damage, ownership."""

import gc
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel

import gsba
from gsba.disk import atomic_write, concatenated
from gsba.log import GsbaError
from gsba.memory import release_mapped_files
from gsba.store import store as store_module
from gsba.store.folder import claim
from gsba.store.records import MIN_MAPPED_BYTES, RecordError, load_record, save_record
from gsba.store.store import RunStore, digest, fingerprint, load_stage
from gsba.types import Counts, Matches, PoseSource, Tracks


@dataclass(frozen=True)
class Everything:
    array: np.ndarray
    empty: np.ndarray
    number: int
    ratio: float
    yes: bool
    name: str
    nothing: Path | None
    paths: tuple[tuple[Path, ...], ...]
    source: PoseSource
    counts: Counts
    fixed: tuple[int, str]
    arrays: Mapping[str, np.ndarray]


def _tracks(value: int = 0) -> Tracks:
    return Tracks(
        points=np.arange(4, dtype=np.int32),
        frames=np.zeros(4, np.int32),
        keypoints=np.full(4, value, np.int32),
        num_points=4,
    )


class _Calls:
    """Remembers which stages were computed."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def tracks(self, name: str, value: int = 0) -> Tracks:
        self.names.append(name)
        return _tracks(value)


def _run(root: Path, calls: _Calls, first: int = 1, second: int = 1, **kwargs: bool) -> RunStore:
    """Three stages: b depends on a, c on neither."""
    with RunStore(root, {"frames": root.parent / "frames"}, **kwargs) as store:
        for name, settings, after in (("a", first, ()), ("b", second, ("a",)), ("c", 0, ())):
            value = store.stage(
                name, settings, lambda name=name: calls.tracks(name), Tracks, after=after
            )
            np.testing.assert_array_equal(value.points, np.arange(4))
    return store


def test_record_round_trip(tmp_path: Path) -> None:
    value = Everything(
        array=np.arange(12, dtype=np.float32).reshape(3, 4).T,
        empty=np.zeros((0, 3), np.uint8),
        number=np.int64(3),  # type: ignore[arg-type]
        ratio=1 / 3,
        yes=True,
        name="a/b é",
        nothing=None,
        paths=((Path("/x/y"),), ()),
        source=PoseSource.INTERPOLATED,
        counts=Counts(received=5, kept=3, unit="frames", dropped={"too dark": 2}),
        fixed=(1, "one"),
        arrays={"left": np.ones(2), "right": np.full((1, 1), np.nan)},
    )
    save_record(tmp_path / "r.npz", value, {})
    back = load_record(tmp_path / "r.npz", Everything)
    np.testing.assert_array_equal(back.array, value.array)
    assert back.array.dtype == np.float32
    assert back.empty.shape == (0, 3) and back.empty.dtype == np.uint8
    assert np.isnan(back.arrays["right"]).all() and list(back.arrays) == ["left", "right"]
    for name in ("number", "ratio", "yes", "name", "nothing", "paths", "source", "counts", "fixed"):
        assert getattr(back, name) == getattr(value, name), name
    assert type(back.source) is PoseSource and type(back.number) is int


def test_record_is_read_as_its_own_type_only(tmp_path: Path) -> None:
    save_record(tmp_path / "r.npz", _tracks(), {})
    with pytest.raises(RecordError, match="not a Matches"):
        load_record(tmp_path / "r.npz", Matches)
    with pytest.raises(RecordError):
        load_record(tmp_path / "r.npz", tuple[Tracks, Counts])


def test_objects_are_refused_not_pickled(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="cannot store a object"):
        save_record(tmp_path / "r.npz", (1, object()), {})
    with pytest.raises(ValueError, match="pickle"):
        save_record(tmp_path / "r.npz", np.array([{}], dtype=object), {})
    assert list(tmp_path.iterdir()) == []


def _many_tracks() -> Tracks:
    rows = np.arange(2 * MIN_MAPPED_BYTES // 4, dtype=np.int32)
    return Tracks(rows, rows[::-1].copy(), rows // 2, len(rows))


def test_threads_read_records_at_once(tmp_path: Path) -> None:
    tracks, path = _tracks(), tmp_path / "record"
    save_record(path, (tracks,) * 20, {})
    interval, threshold = sys.getswitchinterval(), gc.get_threshold()

    def yield_to_others(*_: object) -> None:
        time.sleep(0)

    gc.callbacks.append(yield_to_others)  # threads take turns while headers are parsed
    sys.setswitchinterval(1e-6)
    gc.set_threshold(10)
    gc.freeze()
    try:
        with ThreadPoolExecutor(8) as pool:
            found = list(
                pool.map(lambda _: load_record(path, tuple[Tracks, ...])[0].num_points, range(64))
            )
    finally:
        gc.unfreeze()
        gc.set_threshold(*threshold)
        sys.setswitchinterval(interval)
        gc.callbacks.remove(yield_to_others)
    assert found == [tracks.num_points] * 64


def test_large_arrays_stay_on_the_disk(tmp_path: Path) -> None:
    path, given = tmp_path / "tracks.npz", _many_tracks()
    save_record(path, given, {})
    found = load_record(path, Tracks, mapped=True)
    for name in ("points", "frames", "keypoints"):
        array = getattr(found, name)
        np.testing.assert_array_equal(array, getattr(given, name))
        assert not array.flags.owndata and not array.flags.writeable and array.flags.aligned
        assert array.ctypes.data % 64 == 0
    release_mapped_files()
    np.testing.assert_array_equal(found.frames, given.frames)
    save_record(path, _tracks(), {})  # replaced while it is used
    np.testing.assert_array_equal(found.frames, given.frames)
    assert _peak_of_mapping(tmp_path) < 3 * MIN_MAPPED_BYTES


def _peak_of_mapping(folder: Path) -> int:
    """Memory, bytes, that a process takes to store an array of eight times the size and read it
    all, beyond what it took before."""
    code = """
        import sys
        from pathlib import Path
        import numpy as np
        from gsba.disk import concatenated
        from gsba.memory import peak_memory_bytes, release_mapped_files
        from gsba.store.records import MIN_MAPPED_BYTES, load_record, save_record
        piece = np.zeros(MIN_MAPPED_BYTES, np.uint8)
        save_record(Path(sys.argv[1]) / "a.npz", (piece,), {})
        before = peak_memory_bytes()
        array, = concatenated(((piece,) for _ in range(8)), Path(sys.argv[1]))
        save_record(Path(sys.argv[1]) / "a.npz", (array,), {})
        array, = load_record(Path(sys.argv[1]) / "a.npz", tuple[np.ndarray], mapped=True)
        for first in range(0, len(array), MIN_MAPPED_BYTES):
            array[first : first + MIN_MAPPED_BYTES].sum()
            release_mapped_files()
        print(peak_memory_bytes() - before)
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(folder)]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def test_damage_of_an_array_that_stays_on_the_disk_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "tracks.npz"
    save_record(path, _many_tracks(), {})
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(RecordError):
        load_record(path, Tracks, mapped=True)


def test_a_large_result_is_the_one_computed(tmp_path: Path) -> None:
    for compute in (_many_tracks, lambda: pytest.fail("computed again")):
        with RunStore(tmp_path / "run", {}) as store:
            found = store.stage("a", 1, compute, Tracks)
            assert found.num_points == _many_tracks().num_points
            np.testing.assert_array_equal(found.frames, _many_tracks().frames)
            assert not found.frames.flags.owndata


def test_rows_on_the_disk_are_those_in_memory(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    parts = [(rng.normal(size=(n, 3)), rng.integers(0, 9, n)) for n in (0, 5, 0, 7)]
    there, here = concatenated(iter(parts), tmp_path), concatenated(iter(parts), None)
    for one, other in zip(there, here, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert [array.shape for array in concatenated(iter(parts[:1]), tmp_path)] == [(0, 3), (0,)]
    assert not list(tmp_path.iterdir())  # files have no name


def test_second_call_resumes_every_stage(tmp_path: Path) -> None:
    calls = _Calls()
    first = _run(tmp_path / "run", calls)
    again = _run(tmp_path / "run", calls)
    assert calls.names == ["a", "b", "c"]
    assert not any(record.resumed for record in first.records.values())
    assert all(record.resumed for record in again.records.values())
    assert again.records["a"].seconds == first.records["a"].seconds
    assert again.records["a"].peak_mb > 0


@pytest.mark.parametrize(
    ("change", "expected"),
    [({"first": 2}, ["a", "b"]), ({"second": 2}, ["b"]), ({"fresh": True}, ["a", "b", "c"])],
)
def test_a_change_reruns_just_what_depends_on_it(
    tmp_path: Path, change: dict[str, int], expected: list[str]
) -> None:
    _run(tmp_path / "run", _Calls())
    calls = _Calls()
    _run(tmp_path / "run", calls, **change)  # type: ignore[arg-type]
    assert calls.names == expected


def test_stages_of_two_names_do_not_meet(tmp_path: Path) -> None:
    calls = _Calls()
    for _ in range(2):
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            with store.named("first"):
                store.stage("a", None, lambda: calls.tracks("first a"), Tracks)
                store.stage("b", None, lambda: calls.tracks("first b", 1), Tracks, ["a"])
                each = store.per_frame("c", None, {"f": 0}, calls.tracks, Tracks, ["b"])
            store.stage("b", None, lambda: calls.tracks("b", 2), Tracks, ["first-b"])
            assert [*store.records] == ["first-a", "first-b", "first-c", "b"]
            assert load_stage(tmp_path / "run", "first-b", Tracks).keypoints[0] == 1
            assert load_stage(tmp_path / "run", "b", Tracks).keypoints[0] == 2
            assert len(each["f"]) == 4
    assert calls.names == ["first a", "first b", "f", "b"]


def test_another_version_computes_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _run(tmp_path / "run", _Calls())
    monkeypatch.setattr(store_module, "__version__", "999")
    calls = _Calls()
    _run(tmp_path / "run", calls)
    assert calls.names == ["a", "b", "c"]


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text", "other"])
def test_damaged_results_are_computed_again(tmp_path: Path, damage: str) -> None:
    _run(tmp_path / "run", _Calls())
    path = tmp_path / "run/stages/a.npz"
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[data.index(np.arange(4, dtype=np.int32).tobytes())] ^= 1
    damaged = {
        "truncate": data[: len(data) // 2],
        "flip": data,
        "empty": b"",
        "text": b"not a zip file",
        "other": (tmp_path / "run/stages/b.npz").read_bytes(),
    }
    path.write_bytes(damaged[damage])
    calls = _Calls()
    _run(tmp_path / "run", calls)
    assert calls.names == ["a"]


def _features(root: Path, calls: list[str], **items: int) -> dict[str, int]:
    def compute(name: str) -> Tracks:
        calls.append(name)
        return _tracks(items[name])

    with RunStore(root, {}) as store:
        frames = store.per_frame("features", "sift", items, compute, Tracks)
        store.stage("after", None, lambda: calls.append("after"), type(None), after=["features"])
        return {name: int(frames[name].keypoints[0]) for name in frames}


def test_per_frame_results_resume_frame_by_frame(tmp_path: Path) -> None:
    def interrupted(name: str) -> Tracks:
        if name == "f2":
            raise KeyboardInterrupt
        return _tracks(7)

    items = {"f0": 1, "f1": 2, "f2": 3}
    with pytest.raises(KeyboardInterrupt), RunStore(tmp_path / "run", {}) as store:
        store.per_frame("features", "sift", items, interrupted, Tracks)

    calls: list[str] = []
    assert _features(tmp_path / "run", calls, **items) == {"f0": 7, "f1": 7, "f2": 3}
    assert calls == ["f2", "after"]


def test_per_frame_recomputes_changed_frames_and_what_follows(tmp_path: Path) -> None:
    root = tmp_path / "run"
    _features(root, [], f0=1, f1=2, f2=3)
    calls: list[str] = []
    assert _features(root, calls, f0=1, f1=5) == {"f0": 1, "f1": 5}
    assert calls == ["f1", "after"]
    assert not (root / "stages/features/f2.npz").exists()


def test_per_frame_survives_damage_found_late(tmp_path: Path) -> None:
    with RunStore(tmp_path / "run", {}) as store:
        frames = store.per_frame("features", 0, {"f0": 0}, lambda _: _tracks(3), Tracks)
        path = tmp_path / "run/stages/features/f0.npz"
        data = bytearray(path.read_bytes())
        data[data.index(np.arange(4, dtype=np.int32).tobytes())] ^= 1  # header stays readable
        path.write_bytes(data)
        np.testing.assert_array_equal(frames["f0"].points, np.arange(4))


def test_resumes_after_a_kill_in_the_middle(tmp_path: Path) -> None:
    script = textwrap.dedent("""
        import os, signal, sys
        from pathlib import Path
        from gsba.store import records
        from gsba.store.store import RunStore
        from test_store import _tracks
        from gsba.types import Tracks

        with RunStore(Path(sys.argv[1]), {"frames": Path(sys.argv[1]).parent / "frames"}) as store:
            store.stage("a", 1, _tracks, Tracks)
            replace = Path.replace
            Path.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # all but renamed
            store.stage("b", 1, _tracks, Tracks, after=["a"])
    """)
    root = tmp_path / "run"
    folders = (Path(__file__).parent, Path(gsba.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))}
    done = subprocess.run([sys.executable, "-c", script, root], env=environment)
    assert done.returncode == -signal.SIGKILL
    assert len(list((root / "stages").iterdir())) == 2  # a, and half of b
    calls = _Calls()
    _run(root, calls)  # the dead process's lock is no obstacle
    assert calls.names == ["b", "c"]
    assert sorted(path.name for path in (root / "stages").iterdir()) == ["a.npz", "b.npz", "c.npz"]


def test_a_full_disk_is_one_line_and_the_next_call_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with (
        pytest.raises(GsbaError, match=r"no space left .* run again; finished stages are kept$"),
        RunStore(tmp_path / "run", {}) as store,
    ):
        store.stage("a", 1, _tracks, Tracks)
        with monkeypatch.context() as patch:
            patch.setattr(np.lib.format, "write_array", full)
            store.stage("b", 1, _tracks, Tracks)
    assert [path.name for path in (tmp_path / "run/stages").iterdir()] == ["a.npz"]
    with RunStore(tmp_path / "run", {}) as store:
        store.stage("a", 1, lambda: pytest.fail("computed again"), Tracks)
        store.stage("b", 1, _tracks, Tracks)


def test_two_processes_do_not_share_a_run(tmp_path: Path) -> None:
    with RunStore(tmp_path / "run", {}), pytest.raises(GsbaError, match="in use by another"):
        RunStore(tmp_path / "run", {})
    with RunStore(tmp_path / "run", {}):
        pass


def test_foreign_folders_are_refused(tmp_path: Path) -> None:
    _run(tmp_path / "run", _Calls())
    with pytest.raises(GsbaError, match=r"another run .*frames.*--fresh"):
        RunStore(tmp_path / "run", {"frames": tmp_path / "elsewhere"})
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.jpg").touch()
    for fresh in (False, True):
        with pytest.raises(GsbaError, match="not a gsba run"):
            RunStore(tmp_path / "photos", {}, fresh=fresh)
    with pytest.raises(GsbaError, match="is a file"):
        RunStore(tmp_path / "photos/cat.jpg", {})
    (tmp_path / "photos/gsba.json").write_text("[]")
    with pytest.raises(GsbaError, match="not written by gsba"):
        RunStore(tmp_path / "photos", {})


def test_fresh_removes_only_what_gsba_wrote(tmp_path: Path) -> None:
    root = tmp_path / "run"
    _run(root, _Calls())
    for name in ("colmap/sparse/0/images.bin", "trajectory.tum"):
        atomic_write(root / name, lambda path: path.write_text("ours"))
    claim(root, root / "colmap")
    claim(root, root / "trajectory.tum")
    for name in ("notes.txt", "colmap/notes.txt"):
        (root / name).write_text("the user's")
    RunStore(root, {"frames": tmp_path / "elsewhere"}, fresh=True).__exit__()
    left = sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())
    assert left == ["colmap/notes.txt", "gsba.json", "notes.txt"]
    assert not (root / "colmap/sparse").exists()


def test_fresh_stays_inside_the_run(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    _run(tmp_path / "run", _Calls())
    marker = tmp_path / "run/gsba.json"
    marker.write_text(marker.read_text().replace('"wrote": []', '"wrote": ["../mine.txt"]'))
    _run(tmp_path / "run", _Calls(), fresh=True)
    assert (tmp_path / "mine.txt").exists()


def test_a_name_for_results_of_two_types_is_refused(tmp_path: Path) -> None:
    with RunStore(tmp_path / "run", {}) as store:
        store.stage("a", 1, _tracks, Tracks)
        with pytest.raises(ValueError, match="stage a has results of two types"):
            store.stage("a", 2, lambda: Counts(1, 1, "frames"), Counts)


def test_load_stage_reads_a_finished_run(tmp_path: Path) -> None:
    _run(tmp_path / "run", _Calls())
    assert load_stage(tmp_path / "run", "b", Tracks).num_points == 4
    with pytest.raises(GsbaError, match="no usable 'z'"):
        load_stage(tmp_path / "run", "z", Tracks)
    with pytest.raises(GsbaError, match="not a gsba run"):
        load_stage(tmp_path, "b", Tracks)


def test_atomic_write_keeps_the_old_file_when_the_writer_fails(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise ValueError

    with pytest.raises(ValueError):
        atomic_write(path, fail)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_keys_see_settings_paths_and_file_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Settings(BaseModel):
        sigma: float = 0.5

    assert digest(Settings()) == digest(Settings(sigma=0.5)) != digest(Settings(sigma=0.6))
    assert digest(Path("a")) == digest("a") and digest(1) != digest("1")
    with pytest.raises(TypeError, match="cannot be part"):
        digest(object())
    path = tmp_path / "frame.jpg"
    path.write_text("one")
    before = fingerprint([path, None])
    path.write_text("longer")
    assert len(before) == 2 and fingerprint([path, None]) != before
    assert fingerprint([path, None]) != fingerprint([None, path])  # whose file it is
    monkeypatch.chdir(tmp_path)
    assert fingerprint([Path("frame.jpg")]) == fingerprint([path])


def test_a_resumed_call_says_so_in_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for changed in (0, 1):
        caplog.clear()
        with caplog.at_level("INFO", "gsba"), RunStore(tmp_path, {}) as store:
            for name in ("one", "two"):
                store.stage(name, 0, _tracks, Tracks)
            for _ in range(2):  # what this call computed itself is not resumed
                store.stage("three", changed, _tracks, Tracks, ["two"])
        lines = [record.getMessage() for record in caplog.records]
        assert sum(line.startswith("resumed 2 stages of an earlier call") for line in lines) == (
            changed
        )
        assert not any("changed" in line or "resumed, computed" in line for line in lines)
        assert len(lines) == (2 if changed else 3)


def test_stages_that_are_computed_again_cost_their_time_twice(tmp_path: Path) -> None:
    with RunStore(tmp_path, {}) as store:
        store.stage("one", 0, _tracks, Tracks)
        first = store.records["one"].seconds
        assert store.seconds_again == 0
        store.stage("one", 1, _tracks, Tracks)
        assert store.seconds_again == first > 0


def test_records_of_another_run_are_taken_again_where_it_has_others_now(tmp_path: Path) -> None:
    source, taken = tmp_path / "source.npz", list[int]()
    for number in (1, 2, 2):
        save_record(source, number, {"key": f"settings {number}"})
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            taken.append(store.adopt("features", {"0": source}, lambda _: 0, int)["0"])
    source.unlink()  # what was taken stays
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        files = {"0": source, "1": source}
        found = store.adopt("features", files, lambda _: 7, int)
        assert (taken, found["0"], found["1"]) == ([1, 2, 2], 2, 7)
