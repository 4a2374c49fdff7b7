"""W114: files of a run whose NIfTI headers put their voxels at two places.

It is told when the organ is known, since only there the distance matters, and outside of the stages, whose entries in
the cache know no names of files. What it needs of a header is kept with the digest of the file, so that a run of
ordinary files loads nothing for it.
"""


def frame_doubts(inputs, found: dict[str, dict]) -> list[str]:
    """The texts of W114 for the input files of which this is `found`, by role: the `facts` of their frames."""
    if not any("frames" in facts for facts in found.values()):
        return []
    from xfemnav.imaging.reading.nifti_frames import doubts

    slice, segmentation = inputs.value("segment")
    organ = slice.to_world(slice.pixel_centres()[segmentation.mask])
    names = {role: path.name for role, path in inputs.files.items()}
    image = names["image"], found["image"]
    texts = [doubts(names[role], facts, inputs.config.read.nifti_frame, organ, *image) for role, facts in found.items()]
    return list(dict.fromkeys(text for each in texts for text in each))
