"""Write a phantom as files: `python -m data_synthetic FOLDER [--grid A|B] [--motion open|retract|rigid] ...`."""

import argparse

from .files import write
from .phantom import GRIDS, MOTIONS, TUMOURS, Phantom


def main() -> None:
    """Write the image, its brain mask and labels, the cut, the measured motion of the outline, and the truth."""
    parser = argparse.ArgumentParser(prog="python -m data_synthetic", description=main.__doc__)
    parser.add_argument("folder")
    parser.add_argument("--grid", choices=GRIDS, default="A")
    parser.add_argument("--motion", choices=MOTIONS, default="open")
    parser.add_argument("--tumour", choices=TUMOURS, default="beside")
    parser.add_argument("--contrast", choices=["t1gd", "flair"], default="t1gd")
    parser.add_argument("--noise", type=int, metavar="SEED", help="add Rician noise of sigma 20")
    parser.add_argument("--order", help="storage order of the files, such as LAS or PIR")
    parser.add_argument("--oblique", type=float, default=0.0, metavar="DEG", help="turn the slice about the R axis")
    args = parser.parse_args()
    phantom = Phantom(args.tumour, args.contrast, args.motion, GRIDS[args.grid])
    for path in write(phantom, args.folder, seed=args.noise, order=args.order, oblique=args.oblique).values():
        print(path)


if __name__ == "__main__":
    main()
