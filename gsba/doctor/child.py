"""What the process that tries packages does: it says what it begins, and how that went."""

import json
import os
from collections.abc import Sequence
from importlib import import_module

from gsba.doctor import facts


def answer(asked: str, modules: Sequence[str]) -> None:
    """Import modules and find out facts, with a line of JSON on stdout before and after each.

    Args:
        asked: name of a function of `gsba.doctor.facts`, or "".
        modules: names.
    """
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what packages print is no answer

    def say(**what: object) -> None:
        out.write(json.dumps(what) + "\n")
        out.flush()

    usable = True
    for module in modules:
        say(module=module, state="begun")
        try:
            import_module(module)
        except Exception as error:  # whatever an import may raise
            usable = False
            absent = error.name if isinstance(error, ModuleNotFoundError) else None
            text = f"{type(error).__name__}: {error}"
            say(module=module, state="failed", error=text, absent=absent)
        else:
            say(module=module, state="done")
    if asked and usable:
        try:
            say(facts=getattr(facts, asked)())
        except Exception as error:  # of a package that can be imported, but no more
            say(facts={"trouble": f"{type(error).__name__}: {error}"})
