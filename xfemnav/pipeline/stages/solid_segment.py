"""The stage segment of a volume: an image becomes a volume and the mask of the organ in it."""


def compute(params, inputs):
    """The volume, and the organ's mask on it: (Volume, Segmentation)."""
    from xfemnav.imaging.frames.volume import take_volume, values_in
    from xfemnav.imaging.organ.masks import mask_of
    from xfemnav.imaging.organ.solid import organ_in

    image = inputs.image("image")
    volume, mask = take_volume(image), None
    if "mask" in inputs.files:
        given = inputs.image("mask")
        mask = mask_of(given, values_in(given, volume, resample="nearest" if params.resample_mask else None))
    return volume, organ_in(volume, image, mask, params.skull)


def facts(value, params, inputs):
    """What run.json says of the stage."""
    volume, segmentation = value
    frame = {"shape": list(volume.values.shape), "spacing": volume.spacing.tolist(), "affine": volume.affine.tolist()}
    return {"volume": frame, "segmentation": {"method": segmentation.method, **segmentation.info}}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    import numpy as np

    from xfemnav.imaging.frames.slices import to_nifti
    from xfemnav.pipeline.keeping.files import write_nifti

    volume, segmentation = value
    write_nifti(folder / "mask.nii.gz", to_nifti(volume, segmentation.mask, np.uint8))
