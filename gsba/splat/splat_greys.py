"""Grey values of a splat: the family that compares its rendering with captured frames."""

from collections.abc import Sequence
from dataclasses import dataclass

from factors import Block
from factors.splat import SplatBlock
from gsba.bundle.families import Family, MapSnapshot


@dataclass(frozen=True, slots=True)
class SplatGreys(Family):
    """Grey values of frames and of a splat rendered from their poses. See `factors.splat`."""

    name = "splat"
    digest = ""  # stages keep their results by what the block is made of

    block: SplatBlock  # of the captured frames

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """The block of all captured frames."""
        return (self.block,)
