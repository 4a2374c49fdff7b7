"""docs/measured/finite-strain.md, from the kept results."""

from pathlib import Path

from benchmarks.verification.page import number, table

PAGE = Path("docs/measured/finite-strain.md")
WIDE = 4.0  # mm of opening, from where on a jump of the difference is looked for

TEXT = """# Where linear elasticity ends

Written by `python -m benchmarks.finite_strain`. The case is the retraction disc of [accuracy](accuracy.md): radius
70 mm, cut 40 mm deep, lips held from the mouth to half its length and drawn straight apart, E = 3 kPa, nu = .45, plane
strain, skull fixed beyond 15 mm of the mouth. The neo-Hookean tissue stores

    W = mu/2 (I1 - 2 - 2 ln J) + lambda/2 (ln J)^2

per area at rest (plane strain; in plane stress with the thickness that leaves no stress across the plane). Its
constants are those of linear elasticity, which it is to first order. Conditions, springs of the skull and contacts are
those of the linear model, at the places at rest; forces keep their direction; pressures are per length at rest.

## By opening

On a run's own mesh (3 mm, 1 mm in the corridor). *Ramp* is the length over which the skull's grip grows. *Difference*:
the largest distance between where the two models put a piece of tissue, and the same beyond 10 mm of the cut. *Strain*:
the largest principal strain that 1 % of the tissue exceeds, linear and Green-Lagrange's. *Pressure*: mean on the left
lip. Times are of the whole solve.

{openings}
What to make of it:

- **The difference grows with the square of the opening**: for this case about {second:.2g} mm at an opening of 4 mm and
  {third:.2g} mm at 10 mm. Linear retractor pressures are too low, by {pressure:.0f} % at 10 mm.
- **Linear elasticity folds tissue at the widest openings; the neo-Hookean model never does**: its energy is infinite
  where det F = 0.
- **At the widest openings the surface creases.** Between the retractor and the bone it is squeezed. A neo-Hookean
  surface buckles at a stretch of .54 (Biot's instability, and creases from .65), and the difference jumps: by a factor
  of {jump:.2g} between {before:g} and {after:g} mm with the ramp. Where the crease comes depends on the mesh, and on
  what the surface is really like: read such results as a warning, not as a prediction.

## Tip functions

The leading displacement at a tip whose lips slide along each other, r^1/2 sin(theta/2) along the cut, has
det F = 1 - c r^-1/2 sin(theta/2): near enough to the tip it turns tissue inside out on one side, at any load.
Neo-Hookean tissue does not allow that, so with tip functions the load at which no equilibrium is left depends on the
innermost integration point. They are left out by default with this model (`--tip-enrichment none`). What that changes,
with the ramp: relative energy, and the displacement of nodes beyond 2 mm of the cut.

{tips}
## Meshes

Opening 10 mm, with the ramp. *To the finest*: largest difference of displacement to the first row's, beyond 5 mm of the
cut.

{meshes}
A mesh graded at data ends (`--grade-at-data-ends`, elements of micrometres where a blade ends) resolves a singularity
that is infinitely steep: its surface buckles beside the blade's end long before the rest of the tissue is in trouble,
and the run ends with E410. Use that grading with the linear model only, for verification.

## Newton's method

Unbalanced forces on the free unknowns, relative to those of the linear guess, before each step and after the last; each
step is one factorisation. A load is put on in one step if that goes, else in halves of halves; if less than a hundredth
of it does not go either, the run ends with E410, which names the part that was reached.

{residuals}"""


def write_page(results: dict):
    """Write the page."""
    rows = results["openings"]
    at = {row["opening"]: row for row in rows if row["ramp"] == 4}
    jumps = [(b["difference"] / a["difference"], a["opening"], b["opening"])
             for a, b in zip(list(at.values()), list(at.values())[1:]) if a["opening"] >= WIDE and "difference" in b]
    jump, before, after = max(jumps)
    PAGE.write_text(
        TEXT.format(
            jump=jump, before=before, after=after,
            openings=_openings(rows),
            second=at[4.0]["difference"],
            third=at[10.0]["difference"],
            pressure=100 * (1 - at[10.0]["linear kPa"] / at[10.0]["kPa"]),
            tips=_tips(results["tips"]),
            meshes=_meshes(results["meshes"]),
            residuals=table(
                ("opening, mm", "unbalanced forces"),
                [[number(r["opening"]), ", ".join(number(x) for x in r["residuals"])] for r in results["residuals"]],
            ),
        )
    )


def _pair(row, key):
    return f"{number(row['linear ' + key])} / {number(row[key])}" if key in row else number(row["linear " + key])


def _openings(rows):
    head = ("ramp, mm", "opening, mm", "folded, mm², linear / neo-Hookean", "least det F", "difference, mm",
            "beyond 10 mm", "strain", "pressure, kPa", "load steps", "Newton steps", "seconds")
    return table(head, [
        [number(r["ramp"]), number(r["opening"]), _pair(r, "inverted"),
         *_optional(r, "det F", "difference", "beyond 10 mm"), _pair(r, "strain"), _pair(r, "kPa"),
         *_optional(r, "steps", "iterations"), _pair(r, "s")]
        if r["reached"] == 100 else
        [number(r["ramp"]), number(r["opening"]), f"{number(r['linear inverted'])} / E410 at {r['reached']:g} %",
         *8 * [""]]
        for r in rows
    ])


def _tips(rows):
    head = ("lips moved across, mm", "along, mm", "energy with / without - 1", "displacement, mm")
    return table(head, [
        [number(r["across"]), number(r["along"]),
         *(_optional(r, "energy", "beyond 2 mm") if r["reached"] == 100 else (f"E410 at {r['reached']:g} %", ""))]
        for r in rows
    ])


def _meshes(rows):
    head = ("mesh", "nodes", "folded, mm², linear / neo-Hookean", "least det F", "energy, µJ per mm", "pressure, kPa",
            "to the finest, mm", "Newton steps", "seconds, linear / neo-Hookean")
    return table(head, [
        [r["mesh"], r["nodes"], _pair(r, "inverted"),
         *(_optional(r, "det F", "energy", "kPa", "to finest", "iterations") if r["reached"] == 100
           else (f"E410 at {r['reached']:g} %", "", "", "", "")), _pair(r, "s")]
        for r in rows
    ])


def _optional(row, *keys):
    return [number(row[key]) if key in row else "" for key in keys]
