"""The picture of a volume's run: a file, not a value."""

from xfemnav.pipeline.stages.stage_figure import compute, facts

__all__ = ["compute", "facts", "publish"]


def publish(value, params, inputs, folder):
    """Write the stage's public files into `folder`."""
    from xfemnav.pipeline.telling.solid_figure import draw_solid_figure

    volume, segmentation = inputs.value("segment")
    draw_solid_figure(folder / "figure.png", volume, segmentation.mask, inputs.value("constrain"),
                      inputs.value("solve"), inputs.value("warp"), params.display)
