"""Grey values of patches: the family that compares them with the frames that see them."""

from collections.abc import Sequence
from dataclasses import dataclass

from factors import Block, PhotometricBlock
from gsba.bundle.families import Family, MapSnapshot


@dataclass(frozen=True, slots=True)
class PatchGreys(Family):
    """Grey values of patches of some frames in others. See `factors.photometric`."""

    name = "photometric"
    digest = ""  # stages keep their results by what the block is made of

    block: PhotometricBlock  # of sampled patches, whose planes stay as an adjustment leaves them

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """The block of all patches."""
        return (self.block,)
