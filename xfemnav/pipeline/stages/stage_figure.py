"""The picture of a step: a file, not a value."""


def compute(params, inputs):
    """There is no value."""


def facts(value, params, inputs):
    """What run.json says of the stage: nothing."""
    return {}


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.telling.figure import draw_figure

    slice, segmentation = inputs.value("segment")
    draw_figure(folder / "figure.png", slice, segmentation.mask, inputs.value("constrain"), inputs.value("solve"),
                inputs.value("warp"), params.display)
