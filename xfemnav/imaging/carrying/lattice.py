"""When a place is on a point of the image's lattice, and large lattices by parts."""

# A pixel centre this near to an edge (pixels) lies on it: in the tissue, but in no simplex more than once. It is far
# above the rounding of corners that neighbours compute each for itself, and far below what an image can show.
ON_EDGE = 1e-6
# Places this near to a pixel centre (pixels) are the centre: tissue that did not move keeps its values to the last bit.
SAME = 1e-9
SLAB = 1 << 20  # pixels that are looked at at once: what is known of each of them takes 100 bytes


def slabs(shape) -> list[slice]:
    """The rows of a lattice of `shape` (n1, ...) in parts of about SLAB pixels."""
    row = 1
    for n in shape[1:]:
        row *= n
    rows = max(SLAB // row, 1)
    return [slice(at, min(at + rows, shape[0])) for at in range(0, shape[0], rows)]
