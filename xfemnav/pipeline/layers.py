"""Which directory may import which: the one table behind the layer test and the cache keys."""

LAYERS: dict[str, tuple[str, ...]] = {
    "geometry": (),
    "mechanics": ("geometry",),
    "imaging": ("geometry",),
    "pipeline": ("geometry", "mechanics", "imaging"),
    "cli": ("pipeline",),
}


def reach(layer: str) -> tuple[str, ...]:
    """`layer` and all layers below it, sorted: the code that a function of `layer` can run."""
    below = {layer}
    for lower in LAYERS[layer]:
        below.update(reach(lower))
    return tuple(sorted(below))
