"""Compiled loops that put observations in order."""

from factors.compiled import kernel_and_part

_kernel, _ = kernel_and_part()


@_kernel
def frame_spans(frames, owners, first, last):
    """Lower `first` and raise `last` (J,) to the frames that observe each landmark."""
    for o in range(len(frames)):
        first[owners[o]] = min(first[owners[o]], frames[o])
        last[owners[o]] = max(last[owners[o]], frames[o])


@_kernel
def sort_by_owner(frames, owners, offsets, ends, order):
    """Rows of observations by landmark, then frame, then row.

    Landmark j gets order[offsets[j]:offsets[j + 1]]; `ends` (J,) begins as offsets[:-1]. Time is
    linear where the frames of a landmark ascend already.
    """
    for o in range(len(frames)):
        j = owners[o]
        at = ends[j]
        while at > offsets[j] and frames[order[at - 1]] > frames[o]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = o
        ends[j] += 1
