"""The layers of the code: which part may import which.

`tests/test_layers.py` holds every import against this table, and the cache uses it too: the key of a stage covers
all code that the stage's layer can reach, so an edit there re-runs the stage and no other.
"""

LAYERS: dict[str, tuple[str, ...]] = {
    "geometry": (),
    "mechanics": ("geometry",),
    "imaging": ("geometry",),
    "pipeline": ("geometry", "mechanics", "imaging"),
    "cli": ("pipeline",),
}
"""Layer -> the other layers it may import. `xfemnav.errors`, `limits` and `interruption` are open to all."""

ROOMS: dict[str, tuple[str, ...]] = {
    "geometry": ("plane", "solid"),
    "mechanics": ("space", "tissue", "conditions", "solving", "live"),
    "imaging": ("reading", "points", "frames", "organ", "carrying", "selftest"),
    "pipeline": ("keeping", "asking", "telling", "stages", "running"),
}
"""Layer -> its folders, from the ground up: each may import those before it, and the files beside them."""


def reach(layer: str) -> tuple[str, ...]:
    """`layer` and all layers below it, sorted: the code that a function of `layer` can run."""
    below = {layer}
    for lower in LAYERS[layer]:
        below.update(reach(lower))
    return tuple(sorted(below))
