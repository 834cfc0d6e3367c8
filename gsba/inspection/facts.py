"""Facts about a file or folder of footage."""

from dataclasses import dataclass

Facts = tuple[tuple[str, str], ...]  # name and text of each, in the order of the output


@dataclass(frozen=True, slots=True)
class Found:
    """Facts about a path, and its problem if it cannot be refined."""

    facts: Facts
    problem: str = ""  # reason why it cannot be refined; "" = it can


def spoken_seconds(duration_s: float) -> str:
    """Text of a duration: seconds, or minutes and seconds."""
    if duration_s < 100:
        return f"{duration_s:.3g} s"
    minutes, seconds = divmod(round(duration_s), 60)
    return f"{minutes} min {seconds} s"
