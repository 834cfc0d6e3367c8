"""Facts about a run folder: its inputs, result and verdict."""

import json
import shlex
from pathlib import Path

from gsba.inspection.footage import Facts, spoken_seconds
from gsba.report.maps import format_frame_counts
from gsba.store.folder import read_marker


def of_run(folder: Path) -> tuple[Facts, str]:
    """Facts about a run folder, and the command that shows it; "" = it is not finished, and goes on
    by the call that began it, whose options are not known."""
    facts = tuple(read_marker(folder)["origin"].items())
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        took = spoken_seconds(report["summary"]["seconds"])
        result = [
            ("result", f"{format_frame_counts(report)}, {report['summary']['points']:,} points"),
            ("finished", f"{report['finished']}, in {took}, by gsba {report['gsba']}"),
            ("verdict", report["verdict"]["sentence"]),
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        again = "the call that began it, with the same options, goes on where it stopped"
        return (*facts, ("run", f"not finished: {again}")), ""
    datasets = sorted(path.parent.name for path in folder.glob("*/export.json"))
    if datasets:
        result.append(("datasets", ", ".join(datasets)))
    return (*facts, *result), shlex.join(["gsba", "view", str(folder)])
