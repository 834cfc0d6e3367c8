"""Forms of commands: their options as fields of a page, and arguments from the values of fields."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from gsba.log import GsbaError, brief

_ADDRESS = re.compile(r"[a-z]+://[^/,=]*")
_SEPARATORS = re.compile(r"[,=:]")
Kind = Literal["flag", "path", "number", "text"]


@dataclass(frozen=True, slots=True)
class Field:
    """An argument or an option of a command."""

    name: str  # of the parameter
    option: str  # as it is typed, e.g. "--out"; "" = a positional argument
    kind: Kind  # of its value; a flag has none
    help: str  # one line or two
    metavar: str  # stands for the value; "" = none
    required: bool
    repeatable: bool
    parts: int = 1  # values that follow one option


@dataclass(frozen=True, slots=True)
class Form:
    """A command with its arguments and options."""

    command: str  # name of the command
    help: str
    fields: tuple[Field, ...]  # arguments, then options

    def arguments(self, values: Mapping[str, Any]) -> list[str]:
        """Arguments of the command line from the values of fields.

        Args:
            values: by field name: True of a flag; a text or a number; a list of these of a field
                that is repeatable or has several parts. Empty values are left out.

        Raises:
            GsbaError: there is no such field, a required value is missing, or a value is of
                another kind.
        """
        known = {field.name for field in self.fields}
        for name in values:
            if name not in known:
                raise GsbaError(f"gsba {self.command} has no option {brief(name)}")
        positional, options = [], []
        for field in self.fields:
            texts = _texts(field, values.get(field.name))
            if field.required and not texts:
                raise GsbaError(f"{field.option or field.metavar or field.name} is missing")
            if not field.option:
                positional += [f"./{text}" if text.startswith("-") else text for text in texts]
            elif field.kind == "flag":
                options += [field.option] * len(texts)
            elif field.parts > 1:
                options += [field.option, *texts] if texts else []
            else:
                for text in texts:
                    word = f"{field.option}={text}"
                    options += [word] if text.startswith("-") else [field.option, text]
        return [self.command, *positional, *options]

    def paths(self, values: Mapping[str, Any]) -> list[str]:
        """Paths in the values of fields, as `arguments` passes them on.

        Any part of a text may be one, as in `--gps FILE` and `PATH,name=NAME`; addresses such as
        tcp://HOST:PORT hold none.
        """
        found = list[str]()
        for field in self.fields:
            for text in _texts(field, values.get(field.name)):
                if field.kind == "path":
                    found.append(text)
                elif field.kind == "text" and not _ADDRESS.fullmatch(text):
                    found += [text, *(part.strip() for part in _SEPARATORS.split(text))]
        return found


def holds_half_characters(text: str) -> bool:
    """True if a text has surrogates, which no file name and no argument can hold."""
    return any(0xD800 <= ord(character) < 0xE000 for character in text)


def _texts(field: Field, value: Any) -> list[str]:
    """Values of a field as texts."""
    if field.kind == "flag":
        if value not in (None, True, False):
            raise GsbaError(f"{field.option} is on or off, not {brief(str(value))}")
        return ["on"] if value else []
    several = isinstance(value, list)
    if several and not field.repeatable and field.parts != len(value):
        raise GsbaError(f"{field.option or field.name} takes {field.parts} value(s)")
    texts = [_text(field, item) for item in (value if several else [value])]
    return [text for text in texts if text]


def _text(field: Field, value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise GsbaError(f"{field.option or field.name}: {brief(str(value))} is no text or number")
    text = str(value).strip()
    if any(ord(character) < 32 for character in text):
        raise GsbaError(f"{field.option or field.name}: control characters are not allowed")
    if holds_half_characters(text):
        raise GsbaError(f"{field.option or field.name}: half characters are not allowed")
    return text
