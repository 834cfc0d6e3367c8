"""Fuzzing of the command line with thousands of damaged inputs: tracebacks, hangs, wrong output.

    python benchmarks/fuzz/fuzz.py                       # 10,000 cases, on 2 cores about an hour
    python benchmarks/fuzz/fuzz.py --family gps --cases 500 --seed 3
    python benchmarks/fuzz/fuzz.py --case 1234           # repeats one case and prints its output

Case N of a seed is always the same. A walk of a few small frames, its run, a video, a splat and
tables of all kinds are made first (`--out`, kept). Each case copies its inputs, damages a file or
an option, and calls the command line in this process. A worker with limits on time and memory does
this; if it hangs, dies or exceeds its memory, the case is a finding and a new worker goes on.
Expected is
- exit 0, or 3 for a run of several maps, with plausible output: finite poses, a positive scale,
  small residuals;
- exit 1 with one line "error: ..." of readable length, nothing half-written, no input changed;
- exit 2 for options that do not parse.
Any other result is a finding. The exit code is 1 if there is one.
"""

import argparse
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from damage import Spoiled
from inputs import located
from strangers import FAMILIES, prepare, spoil

LIMIT_S = 30.0  # of a case; whole runs get more
GRACE_S = 60.0  # until a worker that ignores signals is killed; the first case compiles kernels
MEMORY_GB = 4.0  # of address space
MOST_LETTERS = 1100  # of a line


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case."""

    number: int
    family: str
    what: str  # description of the damage
    exit_code: int
    seconds: float
    last_line: str  # of stderr
    findings: list[str] = field(default_factory=list)


class _Late(BaseException):
    """Raised in the running case at its time limit."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("benchmark-fuzz"))
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--family", choices=FAMILIES, help="only this one")
    parser.add_argument("--case", type=int, help="only this one, with all its output")
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--worker", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out = options.out.resolve()
    if options.worker or options.case is not None:
        first, last = options.worker or (options.case, options.case + 1)
        for number in range(first, last):
            outcome = run(number, options)
            print(json.dumps(asdict(outcome)), flush=True)
        return
    prepare(options.out)
    started = time.perf_counter()
    outcomes = list(campaign(options))
    lines = table(outcomes, time.perf_counter() - started, options.seed)
    print("\n".join(lines))
    if options.markdown:
        options.markdown.write_text("\n".join([*lines, ""]))
    sys.exit(any(outcome.findings for outcome in outcomes))


def campaign(options: argparse.Namespace) -> Iterator[Outcome]:
    """Yield outcomes of all cases, from a worker that is restarted after each crash."""
    number = 0
    while number < options.cases:
        command = [sys.executable, __file__, "--out", str(options.out), "--seed", str(options.seed)]
        command += ["--family", options.family] if options.family else []
        command += ["--worker", str(number), str(options.cases)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as worker:
            assert worker.stdout is not None
            begun, buffer = time.monotonic(), b""
            while True:
                ready, _, _ = select.select([worker.stdout], [], [], 1.0)
                if ready:
                    read = os.read(worker.stdout.fileno(), 1 << 16)
                    if not read:
                        break
                    *done, buffer = (buffer + read).split(b"\n")
                    for line in done:
                        outcome = Outcome(**json.loads(line))
                        number, begun = outcome.number + 1, time.monotonic()
                        if outcome.findings:
                            print(f"{outcome.number} {outcome}", file=sys.stderr, flush=True)
                        if number % 500 == 0:
                            print(f"{number} cases", file=sys.stderr, flush=True)
                        yield outcome
                limit = spoil(number, options.seed, options.family).limit_s
                if time.monotonic() - begun > limit + GRACE_S:
                    worker.kill()
            code = worker.wait()
        if number < options.cases:
            case = spoil(number, options.seed, options.family)
            what = "hangs in compiled code" if code == -signal.SIGKILL else f"dies of {code}"
            outcome = Outcome(number, case.family, case.what, code, 0.0, "", [what])
            print(f"{outcome}", file=sys.stderr, flush=True)
            number += 1
            yield outcome


def run(number: int, options: argparse.Namespace) -> Outcome:
    """Run one case in its own folder."""
    from typer.testing import CliRunner

    from gsba.cli import app

    soft = int(MEMORY_GB * 2**30)
    resource.setrlimit(resource.RLIMIT_AS, (soft, soft))
    for shown, kind in (("always", RuntimeWarning), ("ignore", ResourceWarning)):
        warnings.simplefilter(shown, kind)  # type: ignore[arg-type]
    case = spoil(number, options.seed, options.family)
    with tempfile.TemporaryDirectory(prefix="gsba-fuzz-") as name, _inside(Path(name)) as folder:
        case.make(options.out, folder)
        before = _contents(folder)
        began = time.perf_counter()
        result: Any = None
        try:
            with _limited(case.limit_s):
                result = CliRunner().invoke(app, located(case.arguments, options.out))
        except _Late:
            pass
        seconds = time.perf_counter() - began
        if result is None:
            return Outcome(number, case.family, case.what, -1, seconds, "", ["hangs"])
        if options.case is not None:
            print(case.arguments, result.output, result.stderr, file=sys.stderr)
            if result.exception and not isinstance(result.exception, SystemExit):
                traceback.print_exception(result.exception)
        findings = list(_complaints(case, result, folder, before))
        last_line = (result.stderr.splitlines() or [""])[-1][:300]
        code = result.exit_code
    return Outcome(number, case.family, case.what, code, seconds, last_line, findings)


@contextmanager
def _inside(folder: Path) -> Iterator[Path]:
    """Make a folder the working folder, so that relative paths stay in it."""
    here = Path.cwd()
    os.chdir(folder)
    try:
        yield folder
    finally:
        os.chdir(here)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    def late(*_: object) -> None:
        raise _Late

    previous = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, previous)


def _contents(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and modification time of every file that a command must not write."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(f): (f.stat().st_size, f.stat().st_mtime_ns) for f in files}


def _complaints(case: Spoiled, result: Any, folder: Path, before: dict) -> Iterator[str]:
    error, text = result.exception, result.stderr
    if error is not None and not isinstance(error, SystemExit):
        yield f"traceback: {type(error).__name__}: {str(error)[:200]}"
        return
    if "unforeseen" in text or "Traceback" in text:
        yield "unforeseen"
    if "out of memory" in text:
        yield "memory"
    if result.exit_code not in (0, 1, 2, 3):
        yield f"exit {result.exit_code}"
    if re.search(r"\.py:\d+: \w*Warning: ", text):
        yield "a warning of Python's"
    if result.exit_code == 1:
        errors = [line for line in text.splitlines() if line.startswith("error: ")]
        if len(errors) != 1 or text.splitlines()[-1] != errors[0]:
            yield "not one line"
        if max(map(len, text.splitlines()), default=0) > MOST_LETTERS:
            yield "a line of thousands of letters"
    if result.exit_code not in (0, 3):
        after = _contents(folder)
        changed = [p for p in before if after.get(p) != before[p] and case.keeps(Path(p))]
        if changed:
            yield f"changed {changed[:3]}"
        out = folder / "out"
        left = {p for p in out.rglob("*") if p.is_file() and case.finished(p.relative_to(out))}
        if left:
            yield f"left {sorted(map(str, left))[:3]}"
        partial = [str(p) for p in folder.rglob("*") if ".partial-" in p.name or "-tmp-" in p.name]
        if partial:
            yield f"left {partial[:3]}"
    else:
        try:
            wrong = case.check(folder, result)
        except Exception as failure:
            wrong = f"output cannot be read: {type(failure).__name__}: {failure}"
        if wrong:
            yield f"nonsense: {wrong}"


def table(outcomes: list[Outcome], seconds: float, seed: int) -> list[str]:
    """Markdown table with a row for each family, and all findings."""
    lines = [
        f"{len(outcomes)} cases of seed {seed} in {seconds:.0f} s.",
        "",
        "| family | cases | succeeded | refused | usage | findings | slowest s |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    rows: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        rows.setdefault(outcome.family, []).append(outcome)
    count: Callable[[list[Outcome], int], int] = lambda some, code: sum(  # noqa: E731
        o.exit_code == code for o in some
    )
    for family, some in [*sorted(rows.items()), ("all", outcomes)]:
        found, slowest = sum(bool(o.findings) for o in some), max(o.seconds for o in some)
        codes = " | ".join(
            str(n) for n in (count(some, 0) + count(some, 3), count(some, 1), count(some, 2))
        )
        lines.append(f"| {family} | {len(some)} | {codes} | {found} | {slowest:.1f} |")
    kinds = Counter(f.partition(":")[0] for o in outcomes for f in o.findings)
    lines += ["", "Findings: " + (", ".join(f"{n} {k}" for k, n in kinds.items()) or "none") + "."]
    for o in outcomes:
        lines += [f"- case {o.number}, {o.family}: {o.what}: {'; '.join(o.findings)}"] * bool(
            o.findings
        )
    return lines


if __name__ == "__main__":
    main()
