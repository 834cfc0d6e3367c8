"""Names of exported images: in the order of the frames when sorted as text, none the end of another
(`1_front.jpg` of `11_front.jpg`, in Brush), and without folders, which several readers drop."""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import zip_longest

from gsba.log import GsbaError

_DIGITS = re.compile(r"(\d+)")


def padded_names(names: Sequence[str]) -> dict[str, str]:
    """Names whose numbers have as many digits as the others of their folder, by frame name.

    Names that only zeros tell apart stay as they are.
    """
    alike = defaultdict[tuple[str, ...], list[list[str]]](list)
    for name in names:
        folder, _, base = name.rpartition("/")
        parts = _DIGITS.split(base)  # text, number, text, ...
        alike[(folder, *parts[::2])].append(parts)
    padded = dict[str, str]()
    for (folder, *texts), rows in alike.items():
        widths = [
            max(map(len, column)) for column in zip(*(row[1::2] for row in rows), strict=True)
        ]
        start = f"{folder}/" if folder else ""
        own = dict[str, str]()
        for row in rows:
            numbers = [number.zfill(width) for number, width in zip(row[1::2], widths, strict=True)]
            pairs = zip_longest(texts, numbers, fillvalue="")
            own[start + "".join(row)] = start + "".join(map("".join, pairs))
        padded |= own if len(set(own.values())) == len(own) else {name: name for name in own}
    return padded


def base_names(names: Mapping[str, str] | Sequence[str]) -> dict[str, str]:
    """Names without folders, by name.

    Args:
        names: names with folders, or such by others.

    Raises:
        GsbaError: two of them get the same name.
    """
    named = names.items() if isinstance(names, Mapping) else ((name, name) for name in names)
    flat, owners = dict[str, str](), dict[str, str]()
    for name, path in named:
        flat[name] = path.replace("/", "_")
        if owners.setdefault(flat[name], name) != name:
            raise GsbaError(
                f"'{owners[flat[name]]}' and '{name}' would both be named '{flat[name]}' in the "
                "export: rename a folder of frames, and refine again"
            )
    return flat
