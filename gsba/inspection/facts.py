"""Facts about a file or folder, as each kind of footage gives them."""

from dataclasses import dataclass

Facts = tuple[tuple[str, str], ...]  # name and text of each, in the order in which people read them


@dataclass(frozen=True, slots=True)
class Found:
    """What was found out about a path."""

    facts: Facts
    problem: str = ""  # why it cannot be refined; "" = it can


def spoken_seconds(duration_s: float) -> str:
    """A duration as people read it."""
    if duration_s < 100:
        return f"{duration_s:.3g} s"
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes} min {seconds} s"
