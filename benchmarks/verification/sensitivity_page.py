"""docs/measured/sensitivity.md, from the kept results."""

from pathlib import Path

from benchmarks.verification.page import number, table

PAGE = Path("docs/measured/sensitivity.md")
LIMIT = 0.05

TEXT = """# How much your choices matter

Written by `python -m benchmarks.sensitivity`. The case is the retraction disc of [accuracy](accuracy.md): radius 70 mm,
cut 40 mm deep, lips held from the mouth to half its length and moved by 3.6 mm each, E = 3 kPa, nu = .45, plane strain,
skull fixed beyond 15 mm of the mouth. The choices are compared on the conforming quadratic reference, so what is shown
is the choice, not the mesh. Changes scale with the retraction.

{choices}
What to make of it:

- **Where the blade ends is a measurement.** Half a millimetre of held lip changes the displacement by {blade:.2g} mm
  beyond 5 mm of the cut. Errors below that verify the software (those of graded meshes are in
  [accuracy](accuracy.md)); they are no clinical accuracy.
- **The craniotomy's size matters near it, Poisson's ratio everywhere.** Report nu and the stress state with every
  result (`run.json` and the report's methods paragraph do).
- **Young's modulus does not matter** where lips are moved by given displacements: displacements depend on ratios of
  stiffness only. It scales the retractor's force; with `--lip-force` it matters in proportion.

## Locking of linear triangles

Linear triangles stiffen as nu nears .5. xfemnav beside the reference at the same nu: error of the strain energy, of the
displacement (rms over rms), and the largest beyond 6 mm of the cut and of the skull's switches, mm.

{locking}
{verdict}
"""


def write_page(results: dict):
    """Write the page."""
    choices = [[r["change"], *(number(r[d]) for d in ("5", "10", "20"))] for r in results["choices"]]
    head = ("changed", "beyond 5 mm of the cut, mm", "beyond 10 mm", "beyond 20 mm")
    blade = max(r["5"] for r in results["choices"] if r["change"].startswith("blade's end .5 mm"))
    rows = results["locking"]
    names = [key for key in rows[0] if key != "poisson"]
    locking = [[f"{r['poisson']:g}", *(number(r[name]) for name in names)] for r in rows]
    PAGE.write_text(
        TEXT.format(
            choices=table(head, choices), blade=blade,
            locking=table(("nu", *(name + (" mesh" if "mesh" not in name else "") for name in names)), locking),
            verdict=_verdict(rows, names),
        )
    )


def _verdict(rows, names):
    """The largest nu up to which every relative error stays under LIMIT."""
    relative = [name for name in names if not name.startswith("worst")]
    good = []
    for r in rows:
        if max(abs(r[name]) for name in relative) > LIMIT:
            break
        good.append(r["poisson"])
    if len(good) == len(rows):
        return f"Up to nu = {good[-1]:g} no error exceeds {100 * LIMIT:g} %."
    over = rows[len(good)]["poisson"]
    return (f"Errors stay under {100 * LIMIT:g} % up to nu = {good[-1]:g}; at {over:g} one exceeds it. "
            "A run above that warns (W405).")
