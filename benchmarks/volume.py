"""All measurements of what is done in space, one after another, and the page docs/measured/volume.md.

    python -m benchmarks.volume [name ...] [--page]

Names: those of TITLES; all without a name. Results are kept in benchmarks/results, and the page is written from all of
them.
"""

import sys
from pathlib import Path

from benchmarks import performance

PAGE = Path("docs/measured/volume.md")
TITLES = {"volume_mesh": "Meshes", "volume_reference": "Displacements beside a conforming reference",
          "volume_solve": "Cutting and solving"}
PREFACE = """# In space

Written by `python -m benchmarks.volume`. One thread; seconds are those that the process had a processor for, and what
is compared ran in turns in one process.

"""


if __name__ == "__main__":
    performance.main(sys.argv[1:], PAGE, PREFACE, TITLES)
