"""Draw docs/architecture.md from the code: its rooms, who imports whom, and what passes through.

    python docs/architecture.py

Writes docs/images/architecture.svg and the tables of docs/architecture.md. Rooms and their floors
are those of docs/rooms.toml, arrows are the imports that files make; see tests/test_rooms.py.
"""

import ast
import re
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE, PAGE, PICTURE = (
    ROOT / "docs" / name for name in ("rooms.toml", "architecture.md", "images/architecture.svg")
)
BACK, ROOM, EDGE, INK, QUIET, ARROW = (
    "#f6f6f3",
    "#ffffff",
    "#c9c8c0",
    "#1b1c1e",
    "#6b6e73",
    "#b9b7ae",
)
FONT = "system-ui,-apple-system,'Segoe UI',Roboto,Helvetica,Arial,sans-serif"
WIDTH, MARGIN, GAP, BETWEEN = 860, 20, 14, 40  # pixels
IN_A_ROW = 3  # most rooms of a floor beside each other: pages are narrow
TITLE, SMALL, LINE = 17, 12.5, 16
LETTER = 0.54  # width of a letter, part of its size


@dataclass(frozen=True)
class Box:
    """A room on the picture."""

    name: str
    x: float
    y: float
    width: float
    height: float
    lines: tuple[str, ...]  # under its name


@cache
def table() -> dict:
    """docs/rooms.toml."""
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


@cache
def modules() -> dict[str, Path]:
    """Dotted name -> file of every module of both packages."""
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for folder in ("gsba", "factors")
        for path in sorted((ROOT / folder).rglob("*.py"))
    }


def room_of(module: str) -> str:
    """Room of a module: a package of gsba, a file beside them, or `factors`."""
    top, _, rest = module.partition(".")
    return rest.partition(".")[0] if top == "gsba" else top


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """All statements of a file, without what only type checkers see."""
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        yield node
        kinds = ast.stmt | ast.ExceptHandler | ast.match_case
        todo += [child for child in ast.iter_child_nodes(node) if isinstance(child, kinds)]


@cache
def imports(path: Path) -> frozenset[str]:
    """Names of all modules that a file imports, anywhere in it; ours down to the file."""
    found = set()
    for node in _statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}: imports are absolute")
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inner & modules().keys()
            if inner - modules().keys():
                found.add(str(node.module))
    return frozenset(found)


@cache
def ties() -> dict[str, frozenset[str]]:
    """Room -> rooms that it imports from; the package itself, which all import, is none."""
    found: dict[str, set[str]] = {room_of(module): set() for module in modules()}
    for module, path in modules().items():
        for other in imports(path) & modules().keys():
            found[room_of(module)].add(room_of(other))
    return {room: frozenset(others - {room, ""}) for room, others in found.items() if room}


def purpose(room: str) -> str:
    """First line of a room's docstring."""
    path = modules()[room if room == "factors" else f"gsba.{room}"]
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines()[0]


def files(room: str) -> list[str]:
    """Names of a room's files, without those for itself alone."""
    prefix = room if room == "factors" else f"gsba.{room}"
    names = [name.removeprefix(f"{prefix}.") for name in modules() if name.startswith(f"{prefix}.")]
    return [name for name in names if not name.startswith("_")]


def direct() -> list[tuple[str, str]]:
    """Ties of rooms that no longer way implies: the picture's arrows."""
    below = ties()

    @cache
    def reach(room: str) -> frozenset[str]:
        return below[room].union(*(reach(other) for other in below[room]))

    return [
        (room, other)
        for room, others in sorted(below.items())
        for other in sorted(others)
        if not any(other in reach(between) for between in others - {other})
    ]


def _rows() -> Iterator[list[str]]:
    """Rooms side by side: those of a floor, in rows that are about equally long."""
    for floor in reversed(table()["floors"]):
        num = -(-len(floor) // IN_A_ROW)
        for n in range(num):
            yield floor[n * len(floor) // num : (n + 1) * len(floor) // num]


def boxes() -> dict[str, Box]:
    """Rooms laid out by floors, the highest first."""
    out, y = {}, 84.0
    for floor in _rows():
        each = min((WIDTH - 2 * MARGIN - GAP * (len(floor) - 1)) / len(floor), 480)
        letters = int((each - 20) / (SMALL * LETTER))
        texts = {}
        for room in floor:
            names = " · ".join(files(room))
            texts[room] = (
                *textwrap.wrap(purpose(room), letters, max_lines=3, placeholder=" …"),
                "",
                *textwrap.wrap(names, letters, break_long_words=False),
            )
            texts[room] = tuple(texts[room][: -1 if not names else None])
        height = 32 + LINE * max(map(len, texts.values()))
        left = (WIDTH - each * len(floor) - GAP * (len(floor) - 1)) / 2
        for n, room in enumerate(floor):
            out[room] = Box(room, left + n * (each + GAP), y, each, height, texts[room])
        y += height + BETWEEN
    return out


def _text(x: float, y: float, text: str, color: str, size: float, weight: int = 400) -> str:
    safe = text.replace("&", "&amp;").replace("<", "&lt;")
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" fill="{color}" font-size="{size}" '
        f'font-weight="{weight}">{safe}</text>'
    )


def _arrow(above: Box, below: Box) -> str:
    x0, y0 = above.x + above.width / 2, above.y + above.height
    x1, y1 = below.x + below.width / 2, below.y - 3
    bend = 0.5 * (y1 - y0)
    return (
        f'<path d="M{x0:.1f} {y0:.1f}C{x0:.1f} {y0 + bend:.1f} {x1:.1f} {y1 - bend:.1f} '
        f'{x1:.1f} {y1:.1f}" fill="none" stroke="{ARROW}" marker-end="url(#tip)"/>'
    )


def _stops() -> list[tuple[str, list[tuple[float, float]]]]:
    """Colour of each way, and its stations: places on the right edge of their rooms' titles."""
    placed = boxes()
    out, used = [], dict.fromkeys(placed, 0)
    for way in table()["ways"]:
        places = []
        for station, _ in way["stations"]:
            box = placed[room_of(_module(station))]
            places.append((box.x + box.width - 15 - 21 * used[box.name], box.y + 16))
            used[box.name] += 1
        out.append((way["color"], places))
    return out


def _lines() -> list[str]:
    """A line along each way."""
    return [
        f'<polyline points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in places)}" fill="none" '
        f'stroke="{color}" stroke-width="1.6" stroke-opacity=".5" stroke-linejoin="round"/>'
        for color, places in _stops()
    ]


def _dots() -> list[str]:
    """The stations' numbers."""
    out = []
    for color, places in _stops():
        for number, (x, y) in enumerate(places, 1):
            out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8.5" fill="{color}"/>')
            out.append(_text(x - 3, y + 3.8, str(number), ROOM, 10.5, 600))
    return out


def _module(station: str) -> str:
    name = station.partition(":")[0]
    return name if name.startswith("factors") else f"gsba.{name}"


def svg() -> str:
    """The picture."""
    placed = boxes()
    height = max(box.y + box.height for box in placed.values()) + MARGIN
    body = [_text(MARGIN, 34, "gsba, floor by floor", INK, 19, 600)]
    x = 245.0
    for way in table()["ways"]:
        body.append(f'<circle cx="{x:.1f}" cy="29" r="6" fill="{way["color"]}"/>')
        body.append(_text(x + 12, 33.5, f"the way of {way['what']}", QUIET, 12))
        x += 190
    grey = "grey: imports, unless a longer way implies them"
    body.append(_text(MARGIN, 58, grey, QUIET, 12))
    body += [_arrow(placed[above], placed[below]) for above, below in direct()]
    for box in placed.values():
        body.append(
            f'<rect x="{box.x:.1f}" y="{box.y:.1f}" width="{box.width:.1f}" '
            f'height="{box.height:.1f}" rx="7" fill="{ROOM}" stroke="{EDGE}"/>'
        )
    body += _lines()
    for box in placed.values():
        body.append(_text(box.x + 10, box.y + 21, box.name, INK, TITLE, 600))
        for n, line in enumerate(box.lines):
            body.append(_text(box.x + 10, box.y + 38 + LINE * n, line, QUIET, SMALL))
    body += _dots()
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height:.0f}" '
        f'width="{WIDTH}" height="{height:.0f}" font-family="{FONT}">\n'
        '<defs><marker id="tip" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto">'
        f'<path d="M0 0L6 3L0 6z" fill="{ARROW}"/></marker></defs>\n'
        f'<rect width="{WIDTH}" height="{height:.0f}" rx="14" fill="{BACK}"/>\n'
        + "\n".join(body)
        + "\n</svg>\n"
    )


def tables() -> dict[str, str]:
    """Name -> lines of the page that the code gives."""
    rooms = ["| floor | room | what for |", "|---:|---|---|"]
    for number, floor in reversed(list(enumerate(table()["floors"], 1))):
        rooms += [f"| {number} | `{room}` | {purpose(room)} |" for room in floor]
    ways = []
    for way in table()["ways"]:
        ways += [f"**{way['what'].capitalize()}**", ""]
        ways += [
            f"{n}. `{station}`: {said}" for n, (station, said) in enumerate(way["stations"], 1)
        ]
        ways.append("")
    return {"rooms": "\n".join(rooms), "ways": "\n".join(ways).rstrip()}


def page(text: str) -> str:
    """A page with its tables renewed, between `<!-- NAME -->` and `<!-- end -->`."""
    for name, content in tables().items():
        text = re.sub(
            rf"(<!-- {name} -->\n).*?(\n<!-- end -->)",
            lambda found, content=content: found[1] + content + found[2],
            text,
            flags=re.DOTALL,
        )
    return text


if __name__ == "__main__":
    PICTURE.write_text(svg(), encoding="utf-8")
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
