"""The files that runs of the small head take, and such a run, for tests that try each option on them."""

import contextlib
import gzip
import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path

import nibabel as nib
import numpy as np
from small import RAS, brain, write

from tests.test_apply import ball, write_tracts
from xfemnav_cli.main import main

X, Y = np.indices((64, 72)) * 2.0 + np.array([-63, -71])[:, None, None]


@dataclass(frozen=True)
class Run:
    """What came of a command: exit status, what was printed, and its output folder."""

    code: int
    out: str
    err: str
    folder: Path

    @property
    def record(self) -> dict:
        """run.json, empty where there is none."""
        path = self.folder / "run.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def image(self, role="updated") -> nib.Nifti1Image:
        """An output image."""
        return nib.load(self.folder / self.record["outputs"][role])

    def values(self, role="updated") -> np.ndarray:
        """Its values."""
        return self.image(role).get_fdata()

    def digest(self, role="updated") -> str:
        """Digest of an output; of a NIfTI file of its voxels."""
        path = self.folder / self.record["outputs"][role]
        data = gzip.decompress(path.read_bytes())[352:] if path.suffix == ".gz" else path.read_bytes()
        return hashlib.sha256(data).hexdigest()

    def check(self, name: str) -> float:
        """A measure of the run."""
        return self.record["checks"][name]


def run(folder: Path, *words) -> Run:
    """Run the command, which writes into `folder`, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([*map(str, words)])
        except SystemExit as end:
            return Run(end.code or 0, out.getvalue(), err.getvalue(), folder)
    raise AssertionError("the command did not end with an exit code")


def markup(name: str, tip) -> dict:
    """A cut of Slicer's to this tip."""
    places = ([-60, 10, 10], [*tip, 10])
    return {"type": "Line", "name": name, "coordinateSystem": "RAS", "controlPoints": [
        {"label": str(i), "position": place, "positionStatus": "defined"} for i, place in enumerate(places)]}


def files(home: Path) -> None:
    """Write all of them into a folder."""
    head = write(home / "head.nii.gz")
    write(home / "volume.nii.gz", np.stack([brain() * (1 - 0.02 * k) for k in range(20)], 2))
    write(home / "several.nii.gz", np.stack([brain()[..., None], 0.5 * brain()[..., None]], -1))
    write(home / "holed.nii.gz", np.where((X == 5) & (Y == 5), np.nan, brain()))
    write(home / "dusty.nii.gz", np.where(brain() > 0, brain(), 7.0))
    inner = ((X / 41) ** 2 + (Y / 51) ** 2 < 1).astype(np.uint8)
    write(home / "mask.nii.gz", inner)
    write(home / "shifted.nii.gz", inner, RAS + np.diag([0.7], 3))
    spur = np.hypot(X + 8, Y + 30) < 5
    write(home / "labels.nii.gz", np.select([(np.hypot(X + 12, Y - 5) < 8) | spur, np.hypot(X - 10, Y) < 9], [7, 4], 0
                                            ).astype(np.uint8))
    write(home / "vectors.nii.gz", np.broadcast_to([1.0, 2.0, 0.0], (64, 72, 1, 3)).astype(np.float32))
    write(home / "tensors.nii.gz", np.broadcast_to([9.0, 1, 0, 4, 0, 1], (64, 72, 1, 6)).astype(np.float32))
    framed = nib.load(head)
    framed.set_qform(RAS + np.diag([2.0], 3), 1)
    nib.save(framed, home / "framed.nii.gz")
    (home / "cuts.mrk.json").write_text(json.dumps({"@schema": "markups-schema-v1.0.3.json#", "markups": [
        markup("F", [-15, 5]), markup("G", [-25, 5])]}))
    (home / "targets.csv").write_text("r,a,s,label\n-20,20,10,a\n-33,7,10,b\n")
    write_tracts(home / "tracts.tck")
    (home / "lesion.stl").write_bytes(ball(b"no frame", [-1, -1, 1]))
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rows = [f"{45 * np.cos(a)},{55 * np.sin(a)},{-np.cos(a)},0" for a in angle]
    (home / "measured.csv").write_text("x,y,ux,uy\n" + "\n".join(rows))
