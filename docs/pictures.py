"""The pictures of the pages, from the figures of the runs that the pages describe: called by `make docs`."""

from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
WIDTH = 1100  # pixels: every letter can be read, and a repository can carry it


def shrink(source: Path, target: Path) -> None:
    """Write the figure `source` at WIDTH pixels."""
    figure = Image.open(source).convert("RGB")
    size = WIDTH, round(figure.height * WIDTH / figure.width)
    figure.resize(size, Image.Resampling.LANCZOS).save(target, optimize=True)


if __name__ == "__main__":
    for run in ("demo", "worked-case"):
        shrink(DOCS.parent / "out" / run / "figure.png", DOCS / f"{run}.png")
