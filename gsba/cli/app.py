"""The typer application: how commands are registered and how they fail."""

import gc
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Annotated, NoReturn, ParamSpec

import typer
from typer.core import TyperCommand

from gsba.log import GsbaError, brief, show_log
from gsba.version import __version__

P = ParamSpec("P")

_SOURCE = Path(__file__).parents[1]  # not what lies beside it where packages are installed
_MOST_SHOWN = 1000  # characters of a message
_MEMORY_OF = {  # settings that the memory of a stage follows, by the beginning of its name
    "features": "cubemap.max_face_size, features.max_per_face or solver.num_threads",
    "align": "patches.max_width or solver.num_threads",
    "photometric": "photometric.max_width or photometric.targets",
    "splat": "splat.sizes or splat.max_gaussians",
    "export": "export.face_size",
}
_FEWER_POINTS = "features.max_per_face"  # what all other stages follow

app = typer.Typer(
    help="Pixel-true camera poses for 360-degree video, from frames and a SLAM trajectory.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@contextmanager
def _expected_failures() -> Iterator[None]:
    """One line on stderr and an exit code for whatever is no bug of ours."""
    try:
        yield
    except GsbaError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        _fail("interrupted; run again to resume", code=130)
    except BrokenPipeError:  # `gsba ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}")
    except MemoryError as error:
        _fail(_out_of_memory(error))
    except (typer.Exit, typer.Abort):
        raise
    except Exception as error:
        if _Call.debug:
            raise
        _fail(_unforeseen(error))


class _Call:
    """Options of the running call that commands do not see."""

    debug = False


def _out_of_memory(error: MemoryError) -> str:
    """What ran out of memory, and which settings lower it."""
    stage = next(iter(getattr(error, "__notes__", ())), "")
    told = "; ".join(filter(None, (stage and f"stage {stage}", str(error))))
    kind = stage.removeprefix("first-")
    lower = next((s for name, s in _MEMORY_OF.items() if kind.startswith(name)), _FEWER_POINTS)
    advice = f"lower {lower}" if stage else "give smaller input"
    return f"out of memory{f' ({told})' if told else ''}: {advice}, or use a machine with more"


def _unforeseen(error: Exception) -> str:
    """One line on what nobody foresaw: what, where in our code, and how to report it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if Path(f.filename).is_relative_to(_SOURCE)] or frames
    where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
    return (
        f"unforeseen {type(error).__name__} at {where} ({brief(str(error), 200)}): a fault of gsba "
        f"{__version__}; please report this line, and what `gsba --debug` before the same command "
        "shows"
    )


def _fail(message: str, code: int = 1) -> NoReturn:
    """End with one line that any terminal can show, of a length that people read."""
    line = " ".join(message.splitlines()).encode("utf-8", "backslashreplace").decode()
    typer.echo(f"error: {brief(line, _MOST_SHOWN)}", err=True)
    raise typer.Exit(code)


class _Command(TyperCommand):
    def get_help(self, ctx: typer.Context) -> str:  # type: ignore[override]
        """The help without Python's notation for an argument that may be repeated."""
        shown = "<list[Path]>"
        return super().get_help(ctx).replace(shown, "<path>".ljust(len(shown)))


@contextmanager
def loading() -> Iterator[None]:
    """For heavy imports: no garbage is looked for in what stays, now, later or at the end."""
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if gc.get_freeze_count() == 0:  # once: what is frozen is never collected
            gc.freeze()
        if collected:
            gc.enable()


def command(function: Callable[P, None]) -> Callable[P, None]:
    """Register a command whose expected failures end in one line."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        with _expected_failures():
            function(*args, **kwargs)

    name = function.__name__.replace("_", "-")
    return app.command(name, cls=_Command)(run)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gsba {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings only.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every detail.")] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of a failure nobody foresaw.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    _Call.debug = debug
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # what cannot be read is said in our line
    show_log(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
