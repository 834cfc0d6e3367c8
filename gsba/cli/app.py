"""The typer application: registration of commands, and their failures in one line."""

import gc
import inspect
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from functools import cache, wraps
from pathlib import Path
from typing import Annotated, NoReturn, ParamSpec

import typer
from typer.core import TyperCommand

from gsba.cli.options import OPTIONS
from gsba.log import GsbaError, brief, event, show_log
from gsba.version import __version__

P = ParamSpec("P")

_SOURCE = Path(__file__).parents[1]  # folder of gsba's own code
_MEMORY_SETTINGS = {  # first letters of a stage's name -> settings that lower its memory
    "features": "cubemap.max_face_size, features.max_per_face or solver.num_threads",
    "align": "patches.max_width or solver.num_threads",
    "photometric": "solver.num_threads, leave photometric out of factors",
    "splat": "splat.sizes",
    "export": "export.face_size",
}
_DEFAULT_MEMORY_SETTING = "features.max_per_face"  # of all other stages
_ANEW = ("demo", "localize", "mask", "plot", "render")  # commands that resume nothing

app = typer.Typer(
    help="Pixel-true camera poses for 360-degree video, from the video or frames alone, or from a "
    "trajectory.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@contextmanager
def _expected_failures(command_name: str) -> Iterator[None]:
    """End failures of a command with one line on stderr and an exit code, without a traceback."""
    try:
        yield
    except GsbaError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        next_ = (
            "begins anew when it is run again" if command_name in _ANEW else "run again to resume"
        )
        _fail(f"interrupted; {next_}", code=130)
    except BrokenPipeError:  # `gsba ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}")
    except MemoryError as error:
        stage = next(iter(getattr(error, "__notes__", ())), "")
        details = "; ".join(filter(None, (stage and f"stage {stage}", str(error))))
        kind = stage.removeprefix("first-")
        lower = next(
            (settings for name, settings in _MEMORY_SETTINGS.items() if kind.startswith(name)),
            _DEFAULT_MEMORY_SETTING,
        )
        advice = f"lower {lower}" if stage else "give smaller input"
        where = f" ({details})" if details else ""
        _fail(f"out of memory{where}: {advice}, or use a machine with more memory")
    except (typer.Exit, typer.Abort):
        raise
    except Exception as error:
        if _Call.debug:
            raise
        if isinstance(error, ModuleNotFoundError):
            _fail(f"the package {error.name} is missing: `gsba doctor` says how to get it")
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f for f in frames if Path(f.filename).is_relative_to(_SOURCE)] or frames
        where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"
        _fail(
            f"unforeseen {type(error).__name__} at {where} ({brief(str(error), 200)}): a bug in "
            f"gsba {__version__}; please report this line, and the traceback that `gsba --debug` "
            "before the same command shows"
        )


class _Call:
    """Global options of the running call."""

    debug = False


def _fail(message: str, code: int = 1) -> NoReturn:
    """Print one line of limited length that any terminal can show, and exit."""
    line = " ".join(message.splitlines()).encode("utf-8", "backslashreplace").decode()
    message = brief(line, 1000)
    typer.echo(f"error: {message}", err=True)
    event("error", text=message)
    raise typer.Exit(code)


class _Command(TyperCommand):
    def get_help(self, ctx: typer.Context) -> str:  # type: ignore[override]
        """Help text without Python's notation for repeatable arguments."""
        shown = "<list[Path]>"
        return super().get_help(ctx).replace(shown, "<path>".ljust(len(shown)))


@contextmanager
def loading() -> Iterator[None]:
    """Import heavy packages without garbage collection, and exempt them from it for good.

    pycolmap is imported, too: it takes SIGTERM over when it is, to print a stack.
    """
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
        with suppress(ImportError):
            import pycolmap  # noqa: F401
    finally:
        _end_on_sigterm()
        _exempt_loaded_objects()
        if collected:
            gc.enable()


@cache
def _exempt_loaded_objects() -> None:
    """Exempt all objects from garbage collection, once: such objects are never collected."""
    gc.freeze()


def _end_on_sigterm() -> None:
    """Have SIGTERM, by which containers and clusters stop a process, end a command as SIGINT."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def command(function: Callable[P, None]) -> Callable[P, None]:
    """Register a command whose failures end in one line; its help is in `OPTIONS`."""
    name = function.__name__.replace("_", "-")

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        code = 1
        _end_on_sigterm()
        try:
            with _expected_failures(name):
                function(*args, **kwargs)
            code = 0
        except typer.Exit as ending:
            code = ending.exit_code
            raise
        finally:
            event("end", code=code)

    signature = inspect.signature(function)
    parameters = [_described(name, parameter) for parameter in signature.parameters.values()]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return app.command(name, cls=_Command)(run)


def _described(command_name: str, parameter: inspect.Parameter) -> inspect.Parameter:
    """The parameter of a command as typer reads it: with its entry in `OPTIONS`."""
    entry = copy(OPTIONS.get(f"{command_name}.{parameter.name}") or OPTIONS[parameter.name])
    if parameter.annotation is bool and entry.default is ...:  # no names: typer would add --no-NAME
        entry.default = f"--{parameter.name.replace('_', '-')}"
    return parameter.replace(annotation=Annotated[parameter.annotation, entry])


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"gsba {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show warnings only.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every detail.")] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an unforeseen error.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    _Call.debug = debug
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # our own line names unreadable files
    show_log(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
