"""What the files of the motion mean, in words: the JSON beside each of them, by role."""

_FIELD = {"Units": "mm", "VectorFrame": "LPS+"}
_BACKWARD = _FIELD | {
    "Direction": "output->input",
    "Domain": "updated image, up to half a slice off its plane",
    "Outside": "the motion of the tissue beside it for one pixel, then 0",
}
_BRIDGED = _BACKWARD | {
    "InTheGap": "runs from lip to lip: resampled, the gap shows stretched lips; blank it with the cavity mask",
}
_EXTENDED = _BACKWARD | {
    "InTheGap": "the motion of the lip beside it for one pixel, then 10000 mm: resampled, the gap shows background",
}
_FORWARD = _FIELD | {
    "Direction": "input->output",
    "Domain": "preoperative image, up to half a slice off its plane",
    "Outside": "0, also where tissue was taken out",
    "OnTheCut": "one value: within a pixel of a cut between the motions of its lips; there take the mesh",
}

SIDECARS: dict[str, dict] = {
    "transform": _BRIDGED | {"Description": "ITK composite transform: resting position minus position"},
    "transform-extended": _EXTENDED | {
        "Description": "ITK composite transform for resampling: resting position minus position"},
    "field-nrrd": _BRIDGED | {
        "Description": "Displacement field for 3D Slicer (resampling): resting position minus position"},
    "field-nifti": _BRIDGED | {
        "Description": "Displacement field (intent 1007): resting position minus position, the slice three times"},
    "forward-nrrd": _FORWARD | {
        "Description": "Displacement field for 3D Slicer (modeling): position minus resting position"},
    "lips": {
        "Description": "Tissue next to the opened cut, on the updated image's grid", "Type": "ROI",
        "LabelMap": {"1": "left lip", "2": "right lip"},
        "Side": "of the cut, where the tissue rested, seen from the mouth to the tip"},
}
