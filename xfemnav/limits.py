"""Limits beyond which a result deserves a look, a warning, or no trust: one table, for the checks and for the report.

Nothing is imported and nothing decided here: a check compares, warns with its code, and says the number and the limit.
"""

from typing import NamedTuple


class Limit(NamedTuple):
    """The largest (or, where the words say so, smallest) `value` that passes, its `unit`, and what it is a limit of."""

    value: float
    unit: str
    of: str


RESIDUAL = Limit(1e-8, "", "relative residual of the equations; with more there is no result (E407)")

INVERTED = Limit(1.0, "mm²", "tissue turned inside out; more is not trusted (E401)")
# Linear strains grow as r^-1/2 at a tip, so a speck of tissue there is inverted at any opening: this much is no news.
FOLDED_NOTICE = {2: Limit(0.01, "mm²", "tissue turned inside out (W402)"),
                 3: Limit(0.05, "mm³", "tissue turned inside out, in a volume (W402)")}
INVERTED_MM3 = Limit(5.0, "mm³", "tissue turned inside out, in a volume; more is not trusted (E401)")

APART = Limit(0.1, "mm", "distance in the organ between the two frames of a header (W114)")
# A mesh coarser than this tells nothing of what is thin: wider strips of tissue are real.
SHRED_WIDTH = Limit(4.0, "mm", "the element's width under which tissue beside a resection goes with it (W210)")
# Springs of 1e-6 E / mm: what they carry moves by as much again when they are half as stiff.
SWAY = Limit(0.1, "mm", "motion that hangs on the springs of what only touches the skull (W410)")
PADDING = Limit(1 << 20, "bytes", "zeros after the voxels of an image, which pass for padding (W136)")

NO_OVERLAP = Limit(0.0, "mm²", "tissue that lies twice (W403)")
# The outlines of two pieces that touch may both hold a pixel's centre.
OVERLAP = Limit(2.0, "mm²", "tissue that lies twice, or two pixels where they are larger; more is not trusted (E401)")

OVERLAP_MM3 = Limit(20.0, "mm³", "tissue that lies twice, in a volume, or two voxels where they are larger; more is "
                                 "not "
                                 "trusted (E401)")

SMALL_STRAIN = Limit(0.1, "", "strain that 1 % of the tissue exceeds: small strains are at their end (a look)")
STRAIN = Limit(0.3, "", "strain that 1 % of the main tissue exceeds: no model here describes it (W406)")

# The linear model takes sin(theta) for the rotation and 1 for cos(theta): tissue of the size L that is turned by theta
# is blown up and misplaced by L theta^2 / 2. Finite strains have that right.
TURNING = Limit(1.0, "mm", "misplacement of the main tissue that turns, by small rotations (W407)")

# A brain keeps its area but for a few percent. A linear solution has det F = 1 + tan(theta)^2 where it turns tissue by
# theta: 2 at 45 degrees. At 3 it would have to turn by more than the sine of any angle: it is no motion of a solid.
RESIZED_TIMES, TRIPLED_TIMES = 2.0, 3.0
RESIZED = Limit(10.0, "mm²", "main tissue whose area more than doubles or halves (W407)")
RESIZED_MM3 = Limit(100.0, "mm³", "main tissue whose volume more than doubles or halves (W407)")
TRIPLED_MM3 = Limit(10.0, "mm³", "main tissue whose volume more than trebles; more is not trusted (E401)")
TRIPLED = Limit(1.0, "mm²", "main tissue whose area more than trebles; more is not trusted (E401)")

# Surfaces shift by up to 20 to 25 mm in the literature.
MOVED = Limit(20.0, "mm", "largest displacement; more is farther than brains shift (W407)")
MOVED_AT_ALL = Limit(50.0, "mm", "largest displacement; more is not trusted (E401)")
STILL = Limit(0.1, "mm", "smallest displacement that is one (W409)")

# 0.006 for 6 mm: what a displacement would be if its number were in metres.
LEAST_METRES = Limit(0.5, "mm", "smallest displacement that may have been given in metres (W409)")
MOST_METRES = Limit(50.0, "mm", "largest displacement that may have been given in metres (W409)")

# 0 to 75 mmHg were measured under retractors, 100 mmHg are 13.3 kPa.
PRESSURE = Limit(13.332, "kPa", "mean pressure of a blade (W408)")
SOFTEST = Limit(0.1, "kPa", "smallest Young's modulus of the main tissue that a brain may have (W408)")
STIFFEST = Limit(100.0, "kPa", "largest Young's modulus of the main tissue that a brain may have (W408)")

NEGATIVE_TENSORS = Limit(1.0, "%", "the organ's tensors with a negative eigenvalue, in the order taken (W133)")
# Noise turns interpolated vectors a little against each other; axes whose signs differ cancel by whole voxels.
SHORT = Limit(0.9, "", "the smallest length of an interpolated vector, over that of its neighbours")
SHRUNK_VECTORS = Limit(5.0, "%", "the organ's interpolated vectors that are shorter than that (W134)")
# Share of neighbouring whole numbers that are equal: .97 to .99 in label maps at 1 mm, up to .2 in T1 and CT.
CONTINUOUS_ALIKE = Limit(0.3, "", "equal neighbours in an image that is taken as continuous; more is asked for (E131)")
LABELS_ALIKE = Limit(0.5, "", "the smallest share of equal neighbours in an image that is taken as labels")
PARTED = Limit(1.0, "mm", "motion of the outline beside a surface's point outside of it; faces across are left out")

# A strip of 23 mm between cut and outline, pushed sideways: 2.5 elements across are 28 % too stiff, 3 are 19 %.
STRIP_ELEMENTS = Limit(3.0, "elements", "smallest width of a strip of tissue between lips, walls and outline (W306)")
SHRED_WIDTH_HELD = Limit(3.0, "mm", "smallest width of tissue, two elements at least, that a blade may hold (W305)")
# Of what is left when half of that width is taken off all round.
SHRED_AREA = Limit(0.02, "", "smallest share of the tissue that a blade may hold (W305)")

BRAIN_MM2 = Limit(22_000.0, "mm²", "cross-section of a brain; more may be a head (W206)")
BRAIN_MM3 = Limit(2_200_000.0, "mm³", "volume of a brain; more may be a head (W206)")
LEAST_BRAIN_MM3 = Limit(200_000.0, "mm³", "least volume of a brain in a stripped volume (W206)")
RIM_DIP = Limit(0.1, "", "dip of brightness below the rim of a stripped slice, of the brightness in depth (W206)")
# Limits of a brain found in a head, set on slices of heads whose brain is known (docs/measured/segmentation.md).
ORGAN_MM2 = Limit(1500.0, "mm²", "least area of the organ (W206)")
LEAST_OF_HEAD = Limit(0.12, "", "least share of the head that is brain (W206)")
MOST_OF_HEAD = Limit(0.8, "", "largest share of the head that is brain (W206)")
VOTERS_AGREE = Limit(0.9, "", "least Dice of the two of three methods that agree best (W206)")
VOTERS_NEAR = Limit(0.62, "", "least Dice of the two that agree next best (W206)")
VOTERS_SURE = Limit(0.97, "", "least Dice of two methods against which the third does not count (W206)")
MERIT = Limit(2.6, "", "least merit of an outline as a brain's (W206)")
# Near the vertex skull, dura and fluid are cut aslant, and look alike.
HIGH_MM2 = Limit(9000.0, "mm²", "least area of a brain in axial slices that are not near the vertex (W206)")
HIGH_MERIT = Limit(3.5, "", "least merit of an outline in a smaller axial slice (W206)")
