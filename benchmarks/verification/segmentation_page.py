"""docs/measured/segmentation.md, from the kept results."""

from pathlib import Path

from benchmarks.verification.page import number, table
from xfemnav import limits

PAGE = Path("docs/measured/segmentation.md")
RIGHT, GOOD = 0.90, 0.95  # Dice below which W206 should speak, and above which it should not

TEXT = """# Segmentation

Written by `python -m benchmarks.segmentation`; `make bench BENCH=segmentation HEADS=folder` measures heads and masks of
your own (benchmarks/segmentation.py says how they are named). Without `--mask` the organ is found in the slice; the
mask is an output (`mask`), the figure shows it, and it is yours to judge. **W206** says that it is doubtful, and why. A
mask of your own (`--mask FILE`) always wins.

## How

1. **Is the skull off?** Stripping tools write one value outside the brain. A head may have constant air too, but its
   rim shows scalp, skull and brain: bright, dark, bright. That is a property of the image, so of a volume it is asked
   in five slices of the same plane through the middle of what it shows, where a skull is cut squarely: near the vertex
   it is cut so aslant that no ring is seen. A lone slice is asked by itself, and where its rim dips by more than
   {dip:g} of the brightness in depth W206 says that a skull may be on.
   `--skull on|stripped` overrules the test.
2. **Stripped:** all that is not background, without its holes.
3. **A head:** three methods (the largest component above Otsu's threshold; a watershed from the core and the scalp; a
   search over thresholds and openings) vote, in four tones: powers of the brightness that bring the core of the head to
   set levels, so that the contrast of the sequence and a tone curve matter little. Taken is the vote whose outline
   looks most like a brain's: a solid, bright shape, in a dark ring, away from the air. Bright fluid around the brain
   (T2) is taken off.
4. **W206** where the two best methods agree by a Dice under {agree:g} or the next by under {near:g} (but for
   two that agree by {sure:g}), where the merit of the outline is under {merit:g} ({high:g} in an axial slice with under
   {small:.0f} mm² of brain, which is near the vertex), or where the brain is under {least:.0%} or over {most:.0%} of
   the head, or under {area:.0f} or over {brain:.0f} mm². The merit: step in brightness at the outline up to .3, plus 4
   solidity, minus 4 times the share of the rim within 8 mm of the air, minus twice the brightness beyond.

Where the image ends inside the organ (**W212** says along how many mm) there is no skull: the outline is held there, no
mouth opens it, and a cut that enters there is refused (E302).

Scale and offset of the intensities do not matter, nor whether the background is the darkest value.

## Measured

Every slice in tones of gamma .5, 1 and 2, each as it is, with a bias of 30 % across it, turned by 10 and 20 degrees,
cropped at one edge, and with all of these: 18 times. *Silent*: under Dice {right:.2f} without W206 (an error is as good
as a doubt). *False alarms*: W206 at Dice {good:.2f} or more. *Stripped*: taken for it.

{tables}
{verdict}
*forrest*: studyforrest, mask by deepbet; *seg3d*: Seg3DData, mask by hand; *stroke*: VolumeRenderingData; *robex*: the
subject of ROBEX's atlas and its mask; *pydeface*: pydeface's average head, mask by ROBEX; both at shares of the brain's
height, so that 15 % is the skull base and 95 % the vertex. {silent}
The limits were set on slices of all these heads: on others expect more silent errors and more doubts. Look at the mask.

## What it is not

It is made for the brain in a head, in T1, T2 and FLAIR-like slices of adults. In slices through the face, the skull
base and the orbits the brain and other tissue touch, and W206 is likely; a mask by a program made for it (SynthStrip,
HD-BET, deepbet, ROBEX), or by hand, is better there, and given with `--mask`. In CT the skull is bright, and W206
speaks. Between pia and dura there is no single right outline: masks of different programs differ there, most in old
brains and near the vertex.
"""


def write_page(results: dict) -> None:
    """Write the page."""
    titles = {"folder": "### Real heads", "synthetic": "### Synthetic heads up to the vertex, and a stripped brain"}
    tables = "\n".join(f"{title}\n\n{_table(results[key])}" for key, title in titles.items() if key in results)
    PAGE.write_text(TEXT.format(
        dip=limits.RIM_DIP.value, brain=limits.BRAIN_MM2.value, agree=limits.VOTERS_AGREE.value,
        near=limits.VOTERS_NEAR.value, sure=limits.VOTERS_SURE.value, merit=limits.MERIT.value,
        high=limits.HIGH_MERIT.value, small=limits.HIGH_MM2.value, least=limits.LEAST_OF_HEAD.value,
        most=limits.MOST_OF_HEAD.value, area=limits.ORGAN_MM2.value, right=RIGHT, good=GOOD, tables=tables,
        verdict=_verdict(rows := [row for rows in results.values() for row in rows]), silent=_doubtless(rows)))


def _doubtless(rows: list[dict]) -> str:
    """Of the worst mistakes: where the brain is wrong and nothing was said."""
    dice = [row["dice"] for row in _silent([row for row in rows if row["dice"] is not None])]
    return f"The silent ones have a Dice of {min(dice):.2f} to {max(dice):.2f}." if dice else ""


def _table(rows: list[dict]) -> str:
    names = list(dict.fromkeys(row["head"] for row in rows))
    head = ("slice", "mean Dice", "least", f"under {RIGHT:g}", "silent", f"{GOOD:g} or more", "false alarms",
            "stripped", "least Dice with its own mask as it is")
    return table(head, [_line(name, [row for row in rows if row["head"] == name]) for name in names])


def _line(name: str, rows: list[dict]) -> list:
    known = [row for row in rows if row["dice"] is not None]
    values = [row["dice"] for row in known]
    steady = [row["steady"] for row in rows if row["steady"] is not None]
    shown = [number(sum(values) / len(values)), number(min(values))] if values else ["", ""]
    counts = [len(_bad(known)), len(_silent(known)), len(_good(known)), len(_alarms(known))] if values else [""] * 4
    doubted = sum(row["doubted"] for row in rows)
    return [name if values else f"{name} (no mask; doubted {doubted} of {len(rows)} times)", *shown, *counts,
            f"{sum(row['method'] == 'stripped' for row in rows)} of {len(rows)}", number(min(steady)) if steady else ""]


def _verdict(rows: list[dict]) -> str:
    known = [row for row in rows if row["dice"] is not None]
    good = _good(known)
    return (f"In all {len(rows)} segmentations, {len(known)} of them with a known brain: {len(_bad(known))} under Dice "
            f"{RIGHT:g}, {len(_silent(known))} of these silent; {len(good)} of Dice {GOOD:g} or more, "
            f"{len(_alarms(known))} of these doubted ({len(_alarms(known)) / max(len(good), 1):.1%}).\n")


def _bad(rows):
    return [row for row in rows if row["dice"] < RIGHT]


def _silent(rows):
    return [row for row in _bad(rows) if not row["doubted"]]


def _good(rows):
    return [row for row in rows if row["dice"] >= GOOD]


def _alarms(rows):
    return [row for row in _good(rows) if row["doubted"]]
