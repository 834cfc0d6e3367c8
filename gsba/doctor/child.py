"""Process that imports packages and reports the start and the result of each import."""

import json
import os
from collections.abc import Sequence
from importlib import import_module

from gsba.doctor import facts


def answer(facts_name: str, modules: Sequence[str]) -> None:
    """Import modules and collect facts, with a line of JSON on stdout before and after each.

    Args:
        facts_name: name of a function of `gsba.doctor.facts`, or "".
        modules: names of the modules.
    """
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of packages goes to stderr

    def report(**content: object) -> None:
        out.write(json.dumps(content) + "\n")
        out.flush()

    usable = True
    for module in modules:
        report(module=module, state="begun")
        try:
            import_module(module)
        except Exception as error:  # an import may raise any error
            usable = False
            absent = error.name if isinstance(error, ModuleNotFoundError) else None
            text = f"{type(error).__name__}: {error}"
            report(module=module, state="failed", error=text, absent=absent)
        else:
            report(module=module, state="done")
    if facts_name and usable:
        try:
            report(facts=getattr(facts, facts_name)())
        except Exception as error:  # the package can be imported, but not used
            report(facts={"trouble": f"{type(error).__name__}: {error}"})
