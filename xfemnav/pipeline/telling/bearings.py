"""Where in the patient a cut enters, which of its lips is which, and where a resection lies: in words.

A wrong sign or a wrong frame is seen in them at once. Sides are told from the middle of the organ, for the origin of a
scanner lies anywhere; distances are those of the world's coordinates, RAS mm.
"""

import math

SIDES = (("left", "right"), ("back", "front"), ("feet", "head"))  # of the patient, at the ends of the RAS axes
ALSO = math.tan(math.pi / 8)  # a second direction counts from halfway between two
MIDDLE_MM = 2.0


class Bearings:
    """What places in a slice are called, with the organ's mask on it."""

    def __init__(self, slice, mask):
        self._slice, self._known = slice, slice.frame_code != 0
        self._middle = slice.to_world(slice.pixel_centres()[mask].mean(axis=0, keepdims=True))[0]

    def of_cut(self, cut) -> str:
        """A sentence without its subject and stop: where the cut begins, and which lip is which."""
        start = "enters" if cut.mouth else "begins inside the organ"
        told = f"{start} {self._place(cut.path[0])}"
        if not self._known:
            return told
        dx, dy = cut.path[-1] - cut.path[0]
        e1, e2, _ = self._slice.axes
        left, right = dx * e2 - dy * e1, dy * e1 - dx * e2
        return (f"{told}; the lip on its left lies towards the patient's {towards(left)}, the one on its right towards "
                f"the {towards(right)}")

    def of_resection(self, resection) -> str:
        """The same of a resection: how much it takes, and where from."""
        inner = resection.region.representative_point()
        return f"takes {resection.area_mm2:.0f} mm2 out {self._place((inner.x, inner.y))}"

    def _place(self, point) -> str:
        if not self._known:
            mm = "({:.1f}, {:.1f}) mm".format(*point)
            return f"at {mm} in the slice, whose header does not say where in the patient it is"
        x, y, z = self._slice.to_world([point])[0]
        if self._slice.plane == "sagittal":
            across = f"{abs(x):.0f} mm {'right' if x > 0 else 'left'} of the origin" if round(x) else "at the origin"
            ahead = _apart(y, "in front of it", "behind it", "level with it")
        else:
            off = x - self._middle[0]
            side = f"on the patient's {'right' if off > 0 else 'left'}"
            across = side if abs(off) >= MIDDLE_MM else "near the patient's middle"
            ahead = _apart(y, "in front of the origin", "behind the origin", "level with the origin")
        return f"{across}, {ahead}, {_apart(z, 'above it', 'below it', 'at its height')}"


def towards(direction) -> str:
    """The sides of the patient that a vector (3,), RAS, points to: one, or two where it lies between them."""
    size = [abs(x) for x in direction]
    order = [k for k in sorted(range(3), key=lambda k: -size[k]) if size[k] > ALSO * max(size)][:2]
    return " and ".join(SIDES[k][int(direction[k] > 0)] for k in order)


def _apart(mm: float, more: str, less: str, none: str) -> str:
    return f"{abs(mm):.0f} mm {more if mm > 0 else less}" if round(mm) else none


def told(record: dict) -> list[str]:
    """The sentences on the cuts and resections of a record, in order."""
    named = [(f"cut '{item['name']}'", item) for item in record.get("cuts", ())]
    named += [(f"resection '{item['name']}'", item) for item in record.get("resections", ())]
    return [f"{name} {item['told']}" for name, item in named if item.get("told")]
