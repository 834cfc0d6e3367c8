"""Tables of `benchmarks/pipeline.py`: rows as Markdown, and the check of the targets.

A row is the dictionary that the benchmark keeps: `sequence`, `row`, `trajectory`, and either
`errors` (gsba.evaluate.trajectory), `wall_s`, `cpu_s`, `peak_mb`, `load`, or `reason`.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

AUC_DEG = ("0.1", "0.25", "0.5", "1", "5")
DEFAULT = "bearing"  # row of the targets and ratios, from the first trajectory
MAX_ATE = {"aisle_loop": 0.003, "gallery_forward": 0.003, "aisle_slam": 0.006}  # rmse, units
MAX_ROTATION = {"aisle_loop": 0.02, "gallery_forward": 0.02}  # median between frames, degrees
MAX_PART = 0.002  # ATE against a peer's result, part of the path, for sequences without a truth
MAX_RESIDUAL = 0.03  # median, degrees, for sequences without a truth
MAX_TIME = 0.25  # of the fastest peer's wall time


def to_markdown(rows: Sequence[dict]) -> str:
    """Table of one sequence."""
    header = ["", "posed", "ATE rmse", "rel. rot. °", *(f"AUC@{angle}°" for angle in AUC_DEG)]
    header += ["wall s", "× ours", "CPU s", "peak MB", "load"]
    lines = [header, ["---"] + ["---:"] * (len(header) - 1)]
    lines += [_cells(row, _ours(rows)) for row in rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def verdicts(rows: Sequence[dict]) -> Iterator[tuple[str, bool]]:
    """Yield the targets of one sequence that its rows can check, with True if they hold."""
    ours = _ours(rows)
    if ours is None:
        yield f"`{DEFAULT}` ends with a result", all(row["row"] != DEFAULT for row in rows)
        return
    errors, name = ours["errors"], ours["sequence"]
    ate, rotation = errors["ate"]["rmse"], errors["rpe_rotation_deg"]["median"]
    yield f"{_posed(ours)} frames posed", errors["num_matched"] == errors["num_truth"]
    if limit := MAX_ATE.get(name):
        yield f"ATE {ate:.5f}, at most {limit}", ate <= limit
    if limit := MAX_ROTATION.get(name):
        yield f"relative rotation {rotation:.4f}°, at most {limit}°", rotation <= limit
    if not ours["truth"]:
        part, residual = ate / ours["path"], ours["residual_deg"]
        text = f"{part:.3%} of the path from the peer's result, at most {MAX_PART:.1%}"
        yield text, part <= MAX_PART
        text = f"median residual {residual:.4f}°, at most {MAX_RESIDUAL}°"
        yield text, residual <= MAX_RESIDUAL
    yield from _against_peers(ours, [row for row in rows if row.get("peer")])


def _against_peers(ours: dict, peers: Sequence[dict]) -> Iterator[tuple[str, bool]]:
    """Yield targets: time against the fastest peer with a result, accuracy against the best."""
    peers = [row for row in peers if "errors" in row and row["machine"] == ours["machine"]]
    if not peers:
        return
    fastest = min(peers, key=lambda row: row["wall_s"])
    ratio = ours["wall_s"] / fastest["wall_s"]
    yield f"wall time {ratio:.2f} of {fastest['row']}, at most {MAX_TIME}", ratio <= MAX_TIME
    if not ours["truth"]:
        return
    area, ate = ours["errors"]["auc"]["0.5"], ours["errors"]["ate"]["rmse"]
    best = max(row["errors"]["auc"]["0.5"] for row in peers)
    yield f"AUC@0.5° {100 * area:.1f}, best peer {100 * best:.1f}", area >= best
    whole = [e for row in peers if (e := row["errors"])["num_matched"] == e["num_truth"]]
    if whole:  # the ATE over a part of the frames is not comparable
        best = min(e["ate"]["rmse"] for e in whole)
        yield f"ATE {ate:.5f}, best peer that posed all frames {best:.5f}", ate <= best


def _ours(rows: Sequence[dict]) -> dict | None:
    return next((row for row in rows if row["row"] == DEFAULT and "errors" in row), None)


def _posed(row: dict) -> str:
    return f"{row['errors']['num_matched']}/{row['errors']['num_truth']}"


def _cells(row: dict, ours: dict | None) -> list[str]:
    source = f" ({Path(row['trajectory']).stem})" if row["trajectory"] else ""
    cells = [row["row"] + source]
    if "errors" in row:
        errors = row["errors"]
        cells += [_posed(row), f"{errors['ate']['rmse']:.5f}"]
        relative = errors["rpe_rotation_deg"]["median"]  # None: no two consecutive frames posed
        cells += ["" if relative is None else f"{relative:.4f}"]
        cells += [f"{100 * errors['auc'][angle]:.1f}" for angle in AUC_DEG]
    else:
        cells += [row["reason"].replace("|", "/"), *[""] * (2 + len(AUC_DEG))]
    if "wall_s" not in row:
        return cells + [""] * 5
    ratio = ""
    if ours is not None and ours["machine"] == row["machine"]:
        ratio = f"{row['wall_s'] / ours['wall_s']:.2f}"
    cells += [f"{row['wall_s']:.1f}", ratio, f"{row['cpu_s']:.1f}"]
    return [*cells, f"{row['peak_mb']:.0f}", f"{row['load']:.1f}"]
