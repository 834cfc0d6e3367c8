"""Figures by matplotlib (extra `plot`), in one style and with reproducible bytes."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

from gsba.disk import atomic_write
from gsba.log import GsbaError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = {  # suffix -> metadata that a file must not hold
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
BEFORE, AFTER, TRUE = "#d9822b", "#1769aa", "#1b1c1e"  # colours of report.html
ALONE = "#2e7d4f"  # colour of a trajectory file that is of no run
_STYLE = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": "medium",
    "font.size": 9.0,
    "grid.color": "#e3e3dd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "savefig.dpi": 200,
    "svg.hashsalt": "gsba",
}


class NoMatplotlibError(GsbaError):
    """A figure needs matplotlib, which is not installed."""


def write(
    paths: Sequence[Path], size_in: tuple[float, float], fill: Callable[["Figure"], None]
) -> None:
    """Draw one figure, and write it to files, atomically.

    Args:
        paths: files, each with a suffix of KINDS.
        size_in: width and height, inches.

    Raises:
        NoMatplotlibError: matplotlib is not installed.
        GsbaError: the disk cannot be written.
    """
    try:
        from matplotlib import style
        from matplotlib.figure import Figure
    except ImportError:
        raise NoMatplotlibError("figures need matplotlib: pip install 'gsba[plot]'") from None

    with style.context(["default", _STYLE]):
        figure = Figure(figsize=size_in, layout="constrained")
        fill(figure)
        for path in paths:
            atomic_write(path, partial(figure.savefig, metadata=KINDS[path.suffix.lower()]))


def colors() -> Iterator[str]:
    """Colours of lines, which repeat after the sixth."""
    return cycle((AFTER, ALONE, "#b3383f", "#7d4fa3", "#8a6d1c", "#258a99"))


def plain(name: str) -> str:
    """Name escaped for matplotlib, which else takes `$` for a formula and hides `_` in legends."""
    return ("\u200b" if name.startswith("_") else "") + name.replace("$", r"\$")
