"""Previews of footage: small pictures and facts, made in the background and kept on disk."""

import hashlib
import json
import os
import select
import stat
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsba.app import runs
from gsba.app.pictures import LARGE, SMALL
from gsba.disk import write_json
from gsba.frames.files import is_image
from gsba.frames.lens_names import lens_files
from gsba.log import GsbaError
from gsba.store.folder import STAGES, is_run_folder
from gsba.version import __version__
from gsba.video.timeline import is_video

_LONGEST_S = 60.0  # that one task may take


_Task = dict[str, Any]  # a picture or facts to be made, as `pictures.answer` takes it


class Previews:
    """Facts and pictures below a root; one process makes them, the newest wish first. `cache`:
    folder of results, made if missing."""

    def __init__(self, root: Path, cache: Path) -> None:
        self._root, self._cache = root, cache
        self._wanted: dict[str, _Task] = {}  # by file of the result; the last is made first
        self._now: str | None = None  # file of the result that is being made
        self._results: dict[str, dict[str, Any]] = {}  # answers since the start
        self._changed = threading.Condition()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None
        self._closed = False

    def about(self, paths: Sequence[Path]) -> list[dict[str, Any]]:
        """Facts and pictures of files as far as they are known; the rest is queued.

        Returns:
            of each path "facts" and "problem", None while they are not known; "picture", True if
            there is one; "pending", True while there may be more.
        """
        found, missing = [], []
        for path in paths:
            if not (path.is_dir() or (path.is_file() and (is_video(path) or is_image(path)))):
                found.append({"facts": {}, "problem": "", "picture": False, "pending": False})
                continue
            picture, facts = self._picture_task(path), self._task(path, {"kind": "facts"})
            if is_run_folder(path):
                known = {"facts": runs.brief_facts(path), "problem": ""}
            else:
                known = self._result(facts)
            shown = self._result(picture)
            open_tasks = [one for one, got in ((facts, known), (picture, shown)) if got is None]
            missing += open_tasks
            problem = None if known is None else known.get("error", known.get("problem"))
            if problem and path.is_dir():  # a folder of several recordings is no fault
                problem = ""
            found.append(
                {
                    "facts": None if known is None else known.get("facts", {}),
                    "problem": problem,
                    "picture": shown is not None and "error" not in shown,
                    "pending": bool(open_tasks),
                }
            )
        self._want(missing[::-1])
        return found

    def facts(self, path: Path) -> dict[str, Any]:
        """Facts about a path, as `gsba info --json` has them, as soon as they are known. Raises
        GsbaError: it cannot be described."""
        if not stat.S_ISREG(path.stat().st_mode) and not path.is_dir():
            raise GsbaError(f"{path.name} is neither a file nor a folder")
        return self._made(self._task(path, {"kind": "facts"}))

    def picture(self, path: Path) -> Path:
        """JPEG of the list's picture of a path. Raises GsbaError: there is none."""
        return self._file(self._picture_task(path))

    def panorama(self, path: Path, share: float) -> Path:
        """JPEG of a panorama to look around in, at a place 0..1 of a video or folder. Raises
        GsbaError: there is none."""
        values = {"kind": "picture", "width": LARGE, "share": min(max(share, 0.0), 1.0)}
        return self._file(self._task(path, values))

    def frame(self, run: Path, frame: int) -> Path:
        """JPEG of the panorama of a finished run's frame. Raises GsbaError: there is none."""
        return self._file(self._task(run, {"kind": "frame", "frame": frame, "width": LARGE}))

    def close(self) -> None:
        """End the process."""
        with self._changed:
            self._closed = True
            self._wanted.clear()
            self._changed.notify_all()
            if self._process is not None:
                self._process.kill()

    def _picture_task(self, path: Path) -> _Task:
        if is_run_folder(path):
            return self._task(path, {"kind": "frame", "frame": 0, "width": SMALL})
        # the first frame of a video often shows a hand
        return self._task(path, {"kind": "picture", "width": SMALL, "share": 0.1})

    def _task(self, path: Path, values: dict[str, Any]) -> _Task:
        """A task whose result is kept under the state of the file, and of the other lens's."""
        files = [path, *(lens_files(path) or ())]
        if is_run_folder(path):
            files = [path / STAGES / f"{name}.npz" for name in ("frames", "reconstruction")]
        states = []
        for each in dict.fromkeys(files):
            try:
                found = each.stat()
                states.append([each.name, found.st_size, found.st_mtime_ns])
            except OSError:
                states.append([each.name])
        key = json.dumps([__version__, str(path), states, values])
        name = hashlib.sha256(key.encode("utf-8", "replace")).hexdigest()[:24]
        kept = self._cache / f"{name}{'.json' if values['kind'] == 'facts' else '.jpg'}"
        relative = f"./{path.relative_to(self._root).as_posix()}"
        return values | {"path": relative, "out": str(kept)}

    def _result(self, task: _Task) -> dict[str, Any] | None:
        """Result of a task; None = it is not known yet."""
        known, kept = self._results.get(task["out"]), Path(task["out"])
        if known is not None or not kept.is_file():
            return known
        known = {}
        if task["kind"] == "facts":
            try:
                known = json.loads(kept.read_text(encoding="utf-8"))
            except (OSError, ValueError):
                return None
        self._results[task["out"]] = known
        return known

    def _made(self, task: _Task) -> dict[str, Any]:
        """Result of a task; waits for it."""
        known = self._result(task)
        if known is None:
            self._want([task])
            with self._changed:
                while (known := self._results.get(task["out"])) is None:
                    if not self._changed.wait(2 * _LONGEST_S) or self._closed:
                        raise GsbaError("the server is busy: try again")
        if "error" in known:
            raise GsbaError(known["error"])
        return known

    def _file(self, task: _Task) -> Path:
        """File of a task's result; waits for it."""
        self._made(task)
        return Path(task["out"])

    def _want(self, tasks: Sequence[_Task]) -> None:
        """Queue tasks; the last of them is made next."""
        with self._changed:
            for task in tasks:
                if task["out"] == self._now or task["out"] in self._results:
                    continue
                self._wanted.pop(task["out"], None)
                self._wanted[task["out"]] = task
            if self._wanted and self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _work(self) -> None:
        self._cache.mkdir(parents=True, exist_ok=True)
        kept = sorted(self._cache.iterdir(), key=lambda path: path.stat().st_mtime)
        # the oldest go first
        for path in kept[: max(0, len(kept) - 6000)]:
            path.unlink(missing_ok=True)
        while True:
            with self._changed:
                while not self._wanted and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                task = self._wanted.popitem()[1]
                self._now = task["out"]
            answer = self._ask(task)
            may_grow = "pip install" in json.dumps(answer)  # a package that is missing today
            if task["kind"] == "facts" and "error" not in answer and not may_grow:
                write_json(Path(task["out"]), answer)
            with self._changed:
                self._results[task["out"]], self._now = answer, None
                self._changed.notify_all()

    def _ask(self, values: dict[str, Any]) -> dict[str, Any]:
        """Answer of the process, which is started if there is none, and ended if it hangs."""
        with self._changed:
            if self._closed:
                return {"error": "the server was closed"}
            if self._process is None:
                self._process = _started(self._root)
            process = self._process
        stdin, stdout = process.stdin, process.stdout
        assert stdin is not None and stdout is not None
        why = "its decoder stopped"
        try:
            stdin.write(json.dumps(values).encode() + b"\n")
            stdin.flush()
            if not select.select([stdout], [], [], _LONGEST_S)[0]:
                why = f"it took more than {_LONGEST_S:.0f} s"
            elif line := stdout.readline():
                return json.loads(line)
        except (OSError, ValueError):
            pass
        process.kill()
        process.wait()
        self._process = None
        return {"error": f"{values['path'][2:]} cannot be read: {why}"}


def _started(root: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "gsba.app.pictures"],
        cwd=root,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
