"""What to think of a run: each check beside its limit, and the warnings and the error that follow.

A check is 'ok', deserves a 'look' (amber in the report; the limit may come with a warning), or is 'untrusted'. Limits
are those of `xfemnav.limits`; what a stage finds in its own work (W402, W403) it says itself.
"""

from typing import NamedTuple

from xfemnav import limits
from xfemnav.limits import Limit

OK, LOOK, UNTRUSTED = "ok", "look", "untrusted"
MMHG_PER_KPA = 7.50062


class Bounds(NamedTuple):
    """What a check may be: up to `look` without a word, up to `untrusted` with trust; `least` is a lower bound."""

    look: Limit | None = None
    untrusted: Limit | None = None
    least: Limit | None = None


BOUNDS = {
    "residual": Bounds(untrusted=limits.RESIDUAL),
    "max_displacement_mm": Bounds(limits.MOVED, limits.MOVED_AT_ALL),
    "inverted_mm2": Bounds(limits.FOLDED_NOTICE[2], limits.INVERTED),
    "inverted_mm3": Bounds(limits.FOLDED_NOTICE[3], limits.INVERTED_MM3),
    "overlap_mm2": Bounds(limits.NO_OVERLAP, limits.OVERLAP),
    "overlap_mm3": Bounds(limits.NO_OVERLAP, limits.OVERLAP_MM3),
    "largest_strain": Bounds(limits.SMALL_STRAIN),
    "main_strain": Bounds(limits.STRAIN),
    "turning_mm": Bounds(limits.TURNING),
    "resized_mm2": Bounds(limits.RESIZED),
    "resized_mm3": Bounds(limits.RESIZED_MM3),
    "tripled_mm2": Bounds(untrusted=limits.TRIPLED),
    "tripled_mm3": Bounds(untrusted=limits.TRIPLED_MM3),
    "blade_pressure_kPa": Bounds(limits.PRESSURE),
    "main_young_kpa": Bounds(limits.STIFFEST, least=limits.SOFTEST),
}


def bounds(name: str, model: str = "linear", pixel_mm2: float = 0.0) -> Bounds:
    """Of a check, with the model 'linear' or 'neo-hookean' and pixels of `pixel_mm2`, voxels of so many mm^3."""
    found = BOUNDS[name]
    if name == "largest_strain" and model != "linear":
        return found._replace(look=limits.STRAIN)
    if name.startswith("overlap"):
        most = found.untrusted
        return found._replace(untrusted=most._replace(value=max(most.value, 2 * pixel_mm2)))
    return found


def verdicts(facts: dict, pixel_mm2: float = 0.0) -> dict[str, dict]:
    """Of each check in `facts` (of one step) that has a limit: value, limit, verdict, and `place_mm` where known."""
    found = {}
    for name in BOUNDS:
        value = facts.get("checks", {}).get(name)
        if value is not None:
            limit, verdict = _judged(value, bounds(name, facts["model"]["name"], pixel_mm2))
            place = facts.get("places", {}).get(name) if verdict != OK else None
            found[name] = {"value": value, "limit": limit, "verdict": verdict} | ({"place_mm": place} if place else {})
    return found


def _judged(value: float, within: Bounds) -> tuple[float, str]:
    """The limit that is passed, or else the first that could be, and the verdict."""
    if within.untrusted and not value <= within.untrusted.value:
        return within.untrusted.value, UNTRUSTED
    if within.look and not value <= within.look.value:
        return within.look.value, LOOK
    if within.least and not value >= within.least.value:
        return within.least.value, LOOK
    return (within.look or within.untrusted).value, OK


def is_trusted(facts: dict, pixel_mm2: float) -> bool:
    """Whether nothing in the facts of a step is untrusted."""
    return all(item["verdict"] != UNTRUSTED for item in verdicts(facts, pixel_mm2).values())


#: Why a result is not to be trusted, by the check that says so.
REASONS = {
    "inverted": "the retraction folds the tissue: {value:.2f} {unit} are inverted, over {limit:g} {unit}",
    "tripled": "tissue is blown up: {value:.3g} {unit}{place} are more than {trebled:g} times as large as at rest, "
               "over {limit:g} {unit}; ask for less, or look whether it hangs on by little",
    "max_displacement_mm": "tissue moves by {value:.3g} mm, over {limit:g} mm; look whether it hangs on by little",
    "overlap": "{value:.1f} {unit} of tissue lie twice, over {limit:g} {unit}: lips, or walls of a resection, have "
               "moved "
               "through each other. Swap left and right if they are swapped, hold both lips, or load less",
}
#: The warning that a check asks for beyond its limit, {finite} with the linear model only.
DOUBTS = {
    "main_strain": ("W406", "1 % of the main tissue is strained by more than {value:.2f}{place}, over {limit:g}, the "
                            "most that this model is for; {finite}ask for a smaller displacement."),
    "turning_mm": ("W407", "{turned:.3g} {unit} of tissue{place} turn by more than {turned_deg:.0f} degrees, which "
                           "small rotations misplace by {value:.2g} mm, over {limit:g} mm; {finite}ask for less, or "
                           "look whether they hang on by little."),
    "resized": ("W407", "{value:.3g} {unit} of tissue{place} more than double or halve their {size}, over {limit:g} "
                        "{unit}; {finite}ask for less, or look whether they hang on by little."),
    "max_displacement_mm": ("W407", "tissue moves by {value:.3g} mm, over {limit:g} mm, farther than brains shift; "
                                    "look whether it hangs on by little."),
    "blade_pressure_kPa": ("W408", "a blade presses with {value:.3g} kPa ({mmhg:.0f} mmHg), harder than any retractor "
                                   "({most_mmhg:.0f} mmHg); Young's modulus is in kPa, forces are in mN per mm."),
    "main_young_kpa": ("W408", "Young's modulus of the main tissue is {value:g} kPa; a brain has {softest:g} to "
                               "{stiffest:g} kPa. Give it in kPa, not Pa."),
}


def reasons(step: str, found: dict[str, dict]) -> list[str]:
    """Why a step ("" for a run without) is not to be trusted, from its verdicts; empty when it is."""
    return [_said(REASONS[plain(name)], step, found[name], unit=_unit(found)) for name in found
            if plain(name) in REASONS and found[name]["verdict"] == UNTRUSTED]


def doubts(step: str, found: dict[str, dict], checks: dict, model: str) -> list[tuple[str, str]]:
    """Codes and texts of the warnings that the verdicts on a step ask for."""
    unit = _unit(found)
    turned = {"turned": checks.get(f"turned_{unit}"), "turned_deg": checks.get("turned_deg"), "unit": unit,
              "size": "volume" if unit == "mm3" else "area"}
    finite = "use ⟦model=neo-hookean⟧, " if model == "linear" and unit == "mm2" else ""
    return [(code, _said(text, step, found[name], finite=finite, **turned))
            for name, (code, text) in ((name, DOUBTS[plain(name)]) for name in found if plain(name) in DOUBTS)
            if found[name]["verdict"] != OK]


def plain(name: str) -> str:
    """The name of a check without the unit of an area or a volume."""
    return name.removesuffix("_mm2").removesuffix("_mm3")


def _unit(found: dict[str, dict]) -> str:
    """The unit of the sizes of tissue among verdicts: mm3 in a volume."""
    return "mm3" if any(name.endswith("_mm3") for name in found) else "mm2"


def stillness(checks: list[dict], taken: bool) -> list[tuple[str, str]]:
    """The warning of a run of whose steps, with these checks, none moves anything; `taken`: tissue was taken out."""
    most = max(each["max_displacement_mm"] for each in checks)
    if most >= limits.STILL.value:
        return []
    but = ", and the image changes by what is taken out alone" if taken else ""
    metres = limits.LEAST_METRES.value <= 1000 * most <= limits.MOST_METRES.value
    unit = f" Lengths are in mm, not m; were metres meant ({1000 * most:.2g} mm)?" if metres else ""
    return [("W409", f"nothing moves: the largest displacement is {most:.2g} mm, under {limits.STILL.value:g} mm{but}."
                     f"{unit} Give an opening (⟦opening_mm⟧), displacements of the lips, or a load, or larger ones.")]


def towards(retractions: list[dict]) -> list[tuple[str, str]]:
    """The warnings of lips that are moved towards the other lip, by a number that counts away from it."""
    return [("W411", f"the {blade['side']} lip of cut '{blade['cut']}' is moved {-blade['normal_mm']:g} mm towards the "
                     "other lip: one number counts away from that, on either side. To part them, give "
                     f"⟦{blade['side']}={-blade['normal_mm']:g}⟧.")
            for blade in retractions if (blade["normal_mm"] or 0) < 0]


def _said(text, step, verdict, **more):
    """A text with its numbers, and with the step that it is about."""
    value, place = verdict["value"], verdict.get("place_mm")
    numbers = {"value": value, "limit": verdict["limit"], "mmhg": value * MMHG_PER_KPA,
               "place": f" about ({', '.join(f'{x:.1f}' for x in place)}) mm" if place else "",
               "trebled": limits.TRIPLED_TIMES, "most_mmhg": limits.PRESSURE.value * MMHG_PER_KPA,
               "softest": limits.SOFTEST.value, "stiffest": limits.STIFFEST.value}
    return (f"in step '{step}' " if step else "") + text.format(**numbers | more)
