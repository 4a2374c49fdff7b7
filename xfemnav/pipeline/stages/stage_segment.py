"""The stage segment: an image becomes a slice and the mask of the organ in it."""


def compute(params, inputs):
    """The slice, and the organ's mask on it: (Slice, Segmentation)."""
    from xfemnav.imaging.frames.slices import take_slice, values_on
    from xfemnav.imaging.organ.masks import mask_of
    from xfemnav.imaging.organ.segment import segment

    image = inputs.image("image")
    slice = take_slice(image, plane=params.plane, index=params.index, position_mm=params.position_mm)
    mask = None
    if "mask" in inputs.files:
        image = inputs.image("mask")
        mask = mask_of(image, values_on(image, slice, resample="nearest" if params.resample_mask else None))
    templates = {role: inputs.image(role) for role in ("template", "template_mask") if role in inputs.files}
    return slice, segment(slice, method=params.method, mask=mask, skull=params.skull, volume=image, **templates)


def facts(value, params, inputs):
    """What run.json says of the stage."""
    slice, segmentation = value
    frame = {name: getattr(slice, name).tolist() for name in ("origin", "spacing", "axes")}
    frame |= {"shape": list(slice.values.shape), "plane": slice.plane, "index": slice.index,
              "offset": slice.offset, "thickness": slice.thickness}
    area = float(segmentation.mask.sum() * slice.spacing.prod())
    return {"slice": frame, "segmentation": {"method": segmentation.method, "area_mm2": area}}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.imaging.frames.slices import to_nifti
    from xfemnav.pipeline.keeping.files import write_nifti

    slice, segmentation = value
    write_nifti(folder / "mask.nii.gz", to_nifti(slice, segmentation.mask, "uint8"))
