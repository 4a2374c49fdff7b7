"""One exception family, one warning family, one table of codes.

Every failure carries a stable code, one line that says what is wrong, where it is, and how to mend it.
`FAULTS` is the only list of codes: the exit status, ``docs/reference/errors.md`` and the program use it. Settings are
called by marks in it, as in all messages (`xfemnav.naming`).
"""

import warnings
from typing import NamedTuple

from xfemnav.naming import Names, said


class Fault(NamedTuple):
    """One row of the table of codes: exit status, one-line title, why it happens, how to mend it."""

    exit_code: int
    title: str
    cause: str
    remedy: str


EXIT_OK, EXIT_SOME_FAILED, EXIT_USAGE, EXIT_UNTRUSTED = 0, 1, 2, 3
EXIT_DATA, EXIT_NO_INPUT, EXIT_BUG = 65, 66, 70
EXIT_CANNOT_WRITE, EXIT_DISK_FULL, EXIT_BUSY, EXIT_CONFIG = 73, 74, 75, 78

FAULTS: dict[str, Fault] = {
    # 1xx: reading images
    "E100": Fault(66, "input file not found", "A file that the run names does not exist.", "Correct the path."),
    "E101": Fault(65, "image file is damaged",
                  "The gzip stream ends early, its CRC does not match, or there are fewer voxels than the header says.",
                  "Copy the file again; check it with `gzip -t FILE`."),
    "E102": Fault(65, "file claims more than it or the memory limit can hold",
                  "The header is wrong, the file is far larger than an image should be, something other than padding follows its voxels, or a file of points unpacks to over a hundred times its size.",
                  "Check the file's origin, or raise ⟦max_memory⟧."),
    "E103": Fault(65, "image has NaN or infinite pixels",
                  "A processing step divided by zero or masked with NaN.",
                  "Give the value to put there: ⟦nan=0⟧."),
    "E105": Fault(65, "image header is not valid",
                  "A field of the header has an impossible value (dimensions, data type, offset), or one that is needed is missing.",
                  "Convert the image again from its source."),
    "E106": Fault(65, "not a file that is read",
                  "The path is a pipe, a device, or a folder without a DICOM series, or it is empty, or its content is no format that xfemnav reads, or a kind of it that is not read (DICOM: several frames in a file, mosaics, rare transfer syntaxes).",
                  "Give images as NIfTI (.nii, .nii.gz), NRRD, MetaImage, MGH/MGZ, or the folder of one DICOM series, converting other kinds of DICOM with dcm2niix; of `xfemnav apply` the message lists what else is carried."),
    "E110": Fault(65, "affine cannot be used",
                  "The matrix from voxels to mm is singular or has NaN, so positions in mm are undefined.",
                  "Fix the header (sform or qform)."),
    "E111": Fault(65, "affine is sheared",
                  "The slice's two array axes are not perpendicular, so its pixels are no rectangles.",
                  "Resample the image to a grid with perpendicular axes."),
    "E120": Fault(65, "volume without a chosen slice",
                  "The image has several slices and xfemnav works on one.",
                  "Give ⟦slice=K⟧ or ⟦slice_mm=S⟧, and ⟦plane⟧ when it is not the axial one."),
    "E121": Fault(65, "image has several volumes", "The image is 4-D.", "Say which one: ⟦volume=N⟧."),
    "E122": Fault(65, "image is not a scalar image", "Colour, complex and vector images have no single intensity.",
                  "Convert it to one scalar a voxel."),
    "E123": Fault(65, "folder holds several DICOM series", "The files in it name more than one series.",
                  "Give a folder with the files of one; the message lists them."),
    "E124": Fault(65, "DICOM slices make no volume",
                  "Slices are missing, doubled, unevenly spaced, or differ in size or orientation.",
                  "Export the whole series again into an empty folder."),
    "E130": Fault(65, "companion lies off the slice",
                  "It has no voxels where the slice's tissue is: its affine or its slice is another one.",
                  "Give its slice at this place, or its whole volume, in the preoperative image's world mm."),
    "E131": Fault(65, "image is not of its kind",
                  "Labels are whole numbers, vectors and axes have 3 values a voxel, symmetric tensors 6; whose axes vectors and tensors are in must be known; whole numbers that may be labels or measurements are not guessed.",
                  "Give its kind: continuous, label, vector, axis or tensor; and ⟦axes⟧, ⟦tensor_order⟧ as the program that wrote it has them."),
    # 2xx: segmentation and mesh
    "E201": Fault(65, "mask is empty", "No pixel belongs to the organ.", "Give your own mask: ⟦mask=FILE⟧."),
    "E202": Fault(65, "image is constant", "Every pixel of the slice has one value; there is nothing to segment.",
                  "Choose another slice, or give ⟦mask=FILE⟧."),
    "E203": Fault(65, "mask covers the whole slice", "The organ has no outline inside the slice.",
                  "Give a mask with background around the organ."),
    "E204": Fault(65, "mask and image have different grids",
                  "The shapes or affines differ, so pixels do not correspond.",
                  "Resample the mask yourself, or give ⟦resample_mask=True⟧."),
    "E205": Fault(65, "volume with its skull, without a mask",
                  "The brain of a volume is not looked for in a head: it is taken from a mask, or from a stripped image.",
                  "Make a mask with SynthStrip, HD-BET or ANTs and give it: ⟦mask=FILE⟧; or say that it is stripped: "
                  "⟦skull_on=stripped⟧."),
    "E206": Fault(65, "template cannot be used", "`svc` needs a template image and its mask on one grid.",
                  "Give both ⟦template=IMG⟧ and ⟦template_mask=FILE⟧."),
    "E207": Fault(65, "element size does not fit the organ",
                  "The mesh would have too many nodes to solve, or too few to be one.",
                  "Change ⟦element_size_mm⟧ or ⟦corridor_element_mm⟧."),
    "E208": Fault(65, "mesh is not good enough",
                  "A triangle is too flat, or the mesh lost a part of the outline narrower than its elements.",
                  "Use a smaller ⟦element_size_mm⟧, or smooth the mask."),
    "E209": Fault(65, "mesh file cannot be used",
                  "The file given with ⟦mesh⟧ is no VTU triangle mesh, or its triangles are flat, overlap, do not connect, or lie beside the organ.",
                  "Write it again as a VTU of triangles in mm (RAS)."),
    # 3xx: cuts
    "E301": Fault(65, "cut does not enter the organ", "No part of the cut lies inside the outline.",
                  "Check the frame of the points: ⟦space=ras|lps|voxel⟧."),
    "E302": Fault(65, "cut lies inside the organ without a mouth",
                  "The first point is deeper than 5 mm, so the cut does not start at the surface; or the image ends inside the organ where the cut enters.",
                  "Start the cut at the surface, or give ⟦internal=True⟧; give an image that holds the organ where the cut enters."),
    "E303": Fault(65, "cut has no length", "All its points coincide, or there is only one.",
                  "Give at least two different points."),
    "E304": Fault(65, "cut crosses itself", "Two segments of one cut meet.", "Draw it again without the loop."),
    "E305": Fault(65, "cut leaves the organ and enters it again", "It crosses the outline more than once, or runs along it.",
                  "Split it into several cuts, or end it inside."),
    "E306": Fault(65, "cut frees a piece that nothing holds",
                  "The cut separates a part of the organ that touches no fixed outline, so it could float away.",
                  "Let the cut end inside, or hold the piece."),
    "E307": Fault(65, "point lies off the slice", "A 3-number point is farther than half a slice from the slice's plane.",
                  "Choose the slice that holds the cut."),
    "E308": Fault(65, "point file cannot be used",
                  "The file is no markups JSON, .fcsv, .csv, .tsv or .tag, is damaged, does not say its frame, or has too few points.",
                  "The message names the place; save the points again."),
    "E309": Fault(65, "several markups in the file",
                  "The file holds more than one set of points, or none of the name that is asked for.",
                  "Say which one by its name, or save it alone."),
    "E310": Fault(65, "resection takes nothing of the organ", "No part of its region lies inside the outline.",
                  "Check the frame of its points: ⟦space=ras|lps|voxel⟧."),
    "E311": Fault(65, "resection has no area", "Its loop has fewer than three different points, or encloses less than the mesh can tell; or what a label or mask marks is nowhere on the slice, or all in bits under the size.",
                  "Draw a closed loop around the tissue taken out."),
    "E312": Fault(65, "resection takes the whole organ", "Nothing is left that could move.", "Draw a smaller one."),
    "E313": Fault(65, "line crosses a place without tissue", "It was drawn in the deformed slice, through an opened cut or a cavity.",
                  "Draw it as several cuts, or in the preoperative slice."),
    "E314": Fault(65, "cut goes through the tissue, in a session", "It takes a piece off, and what holds the pieces is a question for the whole organ.",
                  "Let the cut end inside, or make a run of it."),
    # 4xx: mechanics
    "E401": Fault(3, "result is not to be trusted",
                  "More than 1 mm² of tissue is turned inside out, or grows to more than three times its area; or more than 2 mm² lie twice; or something moves by more than 50 mm. No tissue does that: the model is at its end, or something hangs on by little.",
                  "Give what the message names: the largest part of the opening or force at which the run is trusted, found by solving it. Or hold both lips, or take out what hangs on by little."),
    "E402": Fault(65, "blade is not on the cut", "The blade's fractions are outside 0..1 or leave nothing to hold.",
                  "Give ⟦blade=FROM,TO⟧ with 0 <= FROM < TO < 1."),
    "E403": Fault(65, "two retractions hold one lip", "Two blades overlap on the same lip.",
                  "Give each lip one blade over each span."),
    "E404": Fault(65, "material constant out of range", "Young's modulus must be positive and Poisson's ratio in 0..0.499.",
                  "Correct ⟦young_kpa⟧ or ⟦poisson⟧."),
    "E405": Fault(65, "left and right look swapped",
                  "What is held pushes the lips into each other, or the outline through the skull.",
                  "Swap ⟦left⟧ and ⟦right⟧; left is left when walking from the mouth to the tip."),
    "E406": Fault(65, "nothing holds the organ",
                  "The outline is free and no blade holds the tissue, so it can move rigidly; or a load or a lip carries it, or a piece of it, away from the skull that it touches; or it moves farther than the organ is large.",
                  "Use ⟦skull=fixed⟧, hold a lip or an arc of the outline, and check the units of loads and stiffness."),
    "E407": Fault(70, "linear system was not solved",
                  "Its residual is above the limit, its energy has no minimum, or the forces between lips were not found; or, in a session, tissue beside the cut is too stiff for it.",
                  "In a session, make a run of the cut; else report this with the run's parameters."),
    "E408": Fault(65, "measured boundary displacements cannot be used",
                  "The file has no columns x,y,ux,uy, or its points lie far from the outline, or from each other.",
                  "Check the file's columns and frame, and that points are at most 20 mm apart."),
    "E409": Fault(65, "arc of the outline cannot be used",
                  "Its ends lie far from the outline or hold no facet between them, or a gap to the skull is negative.",
                  "Check the arc's points, their frame and order: arcs run counter-clockwise."),
    "E410": Fault(65, "no equilibrium found at this load",
                  "The neo-Hookean tissue was squeezed flat or buckled before all of the load was on it.",
                  "Ask for no more than the part of the load that the message names; leave out tip functions and fine grading."),
    "E411": Fault(78, "lips by Nitsche's condition are linear", "Its tractions are those of linear elasticity.",
                  "Use ⟦lip_constraint=mortar⟧ with the neo-Hookean model."),
    # 5xx: writing
    "E501": Fault(74, "no space left on the disk", "A result could not be stored.",
                  "Free some space and run the same command again; finished stages are kept."),
    "E502": Fault(73, "cannot write there", "The folder is read-only or belongs to somebody else.",
                  "Give another folder with ⟦output⟧ or ⟦cache⟧."),
    "E503": Fault(75, "another run holds this output folder", "Two runs write to one folder.", "Wait for it, or give another ⟦output⟧."),
    "E504": Fault(73, "folder is no cache", "It holds files that xfemnav has not made, and a cache may be pruned.",
                  "Give an empty folder, or one that is not there yet, with ⟦cache⟧."),
    # 7xx: other files and settings
    "E701": Fault(65, "file cannot be read", "A file beside the image is not in its format.", "Write it again."),
    "E702": Fault(65, "input has changed since the run", "A file that the run has read holds something else now, so that the run's motion is not of it.",
                  "Put the file of then back, or run again with the one of now."),
    "E703": Fault(65, "output is not the run's", "A file that a run has written holds something else now, or its `run.json` is that of another run.",
                  "Put the file of then back, or run again."),
    "E731": Fault(73, "output would overwrite a file that is not its own",
                  "The output folder holds a file that the run reads, or one of an output's name that no `run.json` there claims.",
                  "Give another ⟦output⟧, or move the file."),
    "E780": Fault(78, "scenario or option is not valid", "A value has the wrong type, name or range.",
                  "The message lists every problem with its place."),
    "E781": Fault(78, "scenario names a file outside its folder", "Paths in a scenario stay in its folder, so that a scenario from elsewhere reads no file of yours.",
                  "Move the file, pass it on the command line, or allow it: ⟦allow_outside=True⟧ (in a scenario, `allow_outside = true`)."),
    "E800": Fault(71, "not enough memory", "The mesh or the image is larger than the memory that the run may use.",
                  "Use larger elements, a smaller image, or a machine with more memory."),
    "E900": Fault(70, "bug in xfemnav", "Something happened that should not.", "Report it with its traceback."),
    # warnings
    "W104": Fault(0, "intensity scaling ignored", "scl_slope or scl_inter is NaN or infinite.", "Check the header."),
    "W107": Fault(0, "file name and content disagree", "The content is gzip without .gz, or the other way round.", "Rename it."),
    "W112": Fault(0, "no position in the header", "The header does not say how its axes lie in the patient (NIfTI: qform and sform codes are 0; NRRD: no space; MGH: goodRASFlag is 0; GIfTI: space unknown, no VolGeom).",
                  "Do not trust world positions; use ⟦space=voxel⟧."),
    "W113": Fault(0, "files in a DICOM folder skipped", "They are no DICOM images.", "Check that no slice is among them."),
    "W114": Fault(0, "two frames in the header",
                  "The NIfTI header's qform and sform, or the voxel sizes beside them, put the organ at different places; programs built on ITK (3D Slicer, ANTs) may take the other one.",
                  "Say which one with ⟦nifti_frame=sform|qform⟧, and draw in a program that takes the same; the message names it."),
    "W115": Fault(0, "tracts without a frame",
                  "The .trk file does not say where its voxels lie (no vox_to_ras, or no voxel_order), or says it for voxels of another size than its own; the message says what was taken in its place.",
                  "Write it again with a reference image; check where the tracts lie."),
    "W130": Fault(0, "companion does not cover the tissue", "It has no voxels for a part of it, which has the value of pixels without tissue.",
                  "Do not read it as a measurement."),
    "W131": Fault(0, "points look as if in another frame", "Most of a file's landmarks, or of a surface, lie in the organ only when x and y change sign: LPS read as RAS, or the other way round. Or nothing says in which frame the x,y,z of a .tsv count.",
                  "Check what the file says of its frame: CoordinateSystem, or its columns (r,a,s is RAS, l,p,s and the x,y,z of a .csv are LPS); of a surface that says nothing give ⟦space=lps⟧."),
    "W132": Fault(0, "points lie off the slice", "Landmarks, or all of a surface, are farther than half a slice from its plane, and were moved as the tissue of the slice beside them.",
                  "Do not trust them, or take the slice that holds them."),
    "W133": Fault(0, "tensors in another order",
                  "Over 1 % of the organ's tensors have a negative eigenvalue in the order that was taken.",
                  "Give the order that the message names: ⟦tensor_order⟧."),
    "W134": Fault(0, "vectors shrink",
                  "Neighbouring vectors point in different directions, so that interpolated ones are shorter.",
                  'If they are axes (principal directions), give `kind = "axis"`.'),
    "W135": Fault(0, "kind of the image guessed",
                  "Its name and its header do not say what the values are; its data look like labels, or like measurements.",
                  "Say it: ⟦kind⟧."),
    "W136": Fault(0, "bytes after the voxels",
                  "Zeros follow the voxels that the header describes; they are not looked at.",
                  "None needed, if the program that wrote the file pads it."),
    "W205": Fault(0, "mask cleaned", "Smaller components were dropped or holes filled.", "Check the mask."),
    "W206": Fault(0, "segmentation is doubtful", "Its methods disagree, its outline does not stand out, its size is unusual, or it is not clear whether the skull is off.",
                  "Look at the figure; give ⟦mask=FILE⟧ if it is wrong."),
    "W207": Fault(0, "a part of the mask was lost", "A part hangs on by less than two pixels, and its outline is not the organ's.",
                  "Look at the mask; widen the neck, or take the part off."),
    "W208": Fault(0, "parts of a region are left out",
                  "Of a label or mask that is taken out, separate bits under the size of a resection stay, and what is under two pixels wide.",
                  "None needed for specks; else a smaller ⟦min_resection_mm⟧, or a drawn outline."),
    "W209": Fault(0, "mask has several values",
                  "A mask holds more than 0 and one other value, as a label map, an image or a soft mask do.",
                  "See which pixels were taken: those not 0, or, where there are fractions, half of the range or more."),
    "W210": Fault(0, "shreds taken out",
                  "Tissue that a resection encloses, or that hangs on by less than an element, goes with it.",
                  "Look at the figure; smaller elements keep thin tissue, ⟦loose_pieces=hold⟧ what is enclosed."),
    "W211": Fault(0, "fill looks like tissue",
                  "The value for pixels without tissue, or the 0 of ⟦outside=zero⟧, lies among the values of the organ (1st to 99th percentile).",
                  "Leave ⟦fill⟧ out, for the background's value; or give one that the organ does not have. Leave ⟦outside=zero⟧ out."),
    "W212": Fault(0, "image ends inside the organ",
                  "The organ touches the image's border, where there is no skull; the outline is held there.",
                  "Give an image that holds the whole organ, or do not trust the motion beside the border."),
    "W301": Fault(0, "cut prolonged to the outline", "Its first point was inside, within 5 mm of the outline.", "Check the mouth."),
    "W302": Fault(0, "repeated points merged", "Two neighbouring points of the cut coincide.", "None needed."),
    "W303": Fault(0, "short internal cut", "An internal cut shorter than 3 elements is resolved coarsely.",
                  "Use a smaller element in the corridor."),
    "W304": Fault(0, "branch joined to its cut", "A cut started within 2 mm of another one, deep inside the organ.", "None needed, if it is a branch."),
    "W305": Fault(0, "blade on a sliver",
                  "A blade holds a shred of tissue that hardly hangs together with the rest, and not the rest.",
                  "Move the blade, or take the shred out."),
    "W306": Fault(0, "thin strip of tissue",
                  "A strip of tissue is under three elements wide, where linear triangles are too stiff.",
                  "Use a smaller ⟦corridor_element_mm⟧."),
    "W307": Fault(0, "internal cut has a mouth", "A cut that is said to lie inside begins outside of the organ.", "Start it inside, or do not call it internal."),
    "W311": Fault(0, "small loose piece removed", "A piece smaller than an element was cut free and is not in the result.", "None needed."),
    "W312": Fault(0, "loose piece removed", "A piece that nothing holds was cut free, and removed as asked.", "Check that it was taken out."),
    "W313": Fault(0, "loose piece held at its mean", "A piece that nothing holds was cut free, and kept in its place in the mean as asked.",
                  "Do not trust where it lies."),
    "W314": Fault(0, "label not in the slice", "No part of the organ has a label of the scenario, or a resection's label is nowhere in the map: another slice, another label map, or a wrong number.",
                  "Check the label's number, and that the map covers the slice."),
    "W315": Fault(0, "session condensed anew", "The cut left the corridor of the session, which took as long as making it.",
                  "Give a corridor, or a `reach_mm`, that holds all cuts."),
    "W402": Fault(0, "some tissue is folded", "More than 0.01 mm² is turned inside out.", "Check where; use a smaller displacement."),
    "W403": Fault(0, "tissue lies twice", "A lip that nobody holds has moved through the other, or tissue has folded over itself.",
                  "Hold both lips, or use a smaller displacement."),
    "W404": Fault(0, "blade shortened", "The end of a blade that was given is closer than two elements to the tip.",
                  "Use a smaller TO in ⟦blade⟧, or smaller elements."),
    "W405": Fault(0, "nearly incompressible tissue", "Above Poisson's ratio 0.48 linear triangles stiffen in plane strain: energy or displacement is over 5 % off.",
                  "Use 0.45 to 0.48, or smaller elements, and report the ratio."),
    "W406": Fault(0, "strain beyond the model",
                  "1 % of the main tissue (all but what is far softer) is strained by more than 0.3, which neither small strains nor the neo-Hookean material describe.",
                  "Use a smaller displacement; from 0.1 on, where the check is amber, ⟦model=neo-hookean⟧ is the better one."),
    "W407": Fault(0, "tissue turned or blown up",
                  "Small rotations misplace tissue that turns by more than 1 mm, more than 10 mm² double or halve their area, or something moves by more than 20 mm.",
                  "Look at the place that the message names for a piece that hangs on by little; use ⟦model=neo-hookean⟧, or a smaller displacement."),
    "W408": Fault(0, "pressure or stiffness out of range",
                  "A blade presses with more than 100 mmHg, or Young's modulus of the main tissue is not in 0.1 to 100 kPa: a unit is probably wrong.",
                  "Give Young's modulus in kPa, forces in mN per mm of thickness."),
    "W409": Fault(0, "nothing moves",
                  "The largest displacement, of all steps, is under 0.1 mm.",
                  "Give an opening, a load, or larger ones. A resection alone moves nothing: forces come from blades, gravity, a pressure, or a measured surface."),
    "W410": Fault(0, "contact hangs on springs",
                  "What only touches the skull is kept in place by artificial springs, and the answer depends on them.",
                  "Hold an arc of the outline or a lip."),
    "W411": Fault(0, "lip moved towards the other",
                  "One number moves a lip away from the other lip, on either side of the cut, and this one is negative.",
                  "To part the lips, give a positive number on both sides; else two numbers, the displacement in the plane."),
    "W601": Fault(0, "damaged cache entry recomputed", "A cached file did not match its checksum.", "Check the disk."),
    "W602": Fault(0, "cache is off", "The cache folder cannot be written.", "Give another folder with ⟦cache⟧."),
    "W702": Fault(0, "input has changed since the run", "A run was made again from its `scenario.toml`, and a file of it is not what it was.",
                  "None, where the change is meant; else put the file of then back."),
}


class Coded:
    """What an error and a warning share: a `code` of `FAULTS`, and the `text` with settings marked."""

    def __init__(self, code: str, text: str):
        super().__init__(code, text)
        self.code, self.text = code, text

    def __str__(self) -> str:
        return f"{self.code} {self.message}"

    @property
    def message(self) -> str:
        """The text for users of Python."""
        return said(self.text)


class XfemnavError(Coded, Exception):
    """A failure with a stable `code` of `FAULTS` and a one-line text: what, where, how to mend it.

    In `text` settings are marked (`xfemnav.naming`); `message`, and the error as text, call them as arguments of Python.
    An edge that calls them otherwise says so in `names`, or asks for what is `told` there.
    """

    names: Names | None = None

    def told(self, names: Names) -> str:
        """Code and text in one line, settings as the run's edge calls them, or else as in `names`."""
        return f"{self.code} {said(self.text, self.names or names)}"

    @property
    def exit_code(self) -> int:
        """Exit status of the command that fails with this error."""
        return FAULTS[self.code].exit_code


class XfemnavWarning(Coded, UserWarning):
    """A choice of the user's that deserves a look; `code` is one of the Wnnn of `FAULTS`, `text` and `message` are as
    those of an error."""


def warn(code: str, text: str) -> None:
    """Issue a coded warning; the pipeline records it in run.json, a strict run makes it an error."""
    if code not in FAULTS:
        raise KeyError(code)
    warnings.warn(XfemnavWarning(code, text), stacklevel=2)
