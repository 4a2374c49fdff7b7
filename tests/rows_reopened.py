"""Rows of runs that are made again or opened again, elsewhere and later."""

import shutil
import warnings

import numpy as np
from rows import Row
from small import CUT, brain, write

import xfemnav

COARSE = {"element_size_mm": 8, "corridor_element_mm": 4, "report": False}


def run(folder, **flags):
    """The result of a run on the small brain, whose warnings are in its record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", xfemnav.XfemnavWarning)
        return xfemnav.run(cache=folder / "cache", **flags)


def made_again(folder):
    """A run from its own scenario."""
    image = write(folder / "head.nii.gz")
    first = run(folder, image=image, cut=CUT, left="2,1", output=folder / "out", **COARSE)
    again = run(folder, scenario=first.folder / first.record["outputs"]["scenario"], output=folder / "again",
                report=False)
    names = sorted(path.name for path in first.folder.iterdir())
    same = [name for name in names if (first.folder / name).read_bytes() == (again.folder / name).read_bytes()]
    assert sorted([*same, "run.json"]) == names
    return f"{len(same)} of {len(names)} files have the same bytes; run.json has other seconds and another command", ""


def allowed(folder):
    """A scenario whose image lies beside its folder."""
    write(folder / "head.nii.gz")
    (folder / "case").mkdir()
    case = folder / "case" / "case.toml"
    text = f'xfemnav = 1\nimage = "../head.nii.gz"\n[[cut]]\npoints = {[[-60, 10], [-15, 5]]}\n'
    case.write_text(text)
    given = {"scenario": case, "output": folder / "out", "opening_mm": 4.0}
    try:
        run(folder, **given, **COARSE)
    except xfemnav.XfemnavError as error:
        told = error.message
        assert error.code == "E781" and "allow_outside=True" in told and "allow_outside = true" in told
    else:
        raise AssertionError("read in silence")
    assert run(folder, **given, **COARSE, allow_outside=True).trusted
    case.write_text(text.replace("[[cut]]", "allow_outside = true\n[[cut]]"))
    assert run(folder, **given, **COARSE).trusted
    return "refused, with the flag and the key that allow it; then it runs", "E781"


def moved(folder):
    """The folder of a run moved with its image, alone, and the image alone; it is changed, and gone."""
    (folder / "study").mkdir()
    image = write(folder / "study" / "head.nii.gz")
    run(folder, image=image, cut=CUT, opening_mm=4.0, output=folder / "study" / "out", **COARSE)
    shutil.move(folder / "study", folder / "together")
    assert np.array_equal(opened(folder / "together" / "out"), brain())
    found = ["with its image"]
    shutil.move(folder / "together", folder / "study")
    (folder / "far" / "away").mkdir(parents=True)
    out = shutil.move(folder / "study" / "out", folder / "far" / "away")
    assert np.array_equal(opened(out), brain())
    found.append("alone")
    now = shutil.move(image, folder / "moved.nii.gz")
    text = refused("E100", out)
    assert str(image) in text and str(folder / "far" / "away" / "head.nii.gz") in text and "or give image" in text
    assert np.array_equal(opened(out, image=now), brain())
    write(image, brain() + 1)
    refused("E702", out)
    assert xfemnav.Result.load(out).landmarks([[-20.0, 20.0]]).flag == ("tissue",)
    return f"opened when moved {' and '.join(found)}; the image moved: E100 with both places; changed: E702", "E100"


def opened(folder, **given):
    """The preoperative slice of a run."""
    return xfemnav.Result.load(folder, **given).preoperative.values


def refused(code, folder) -> str:
    """What is said of a run whose image cannot be read again."""
    try:
        opened(folder)
    except xfemnav.XfemnavError as error:
        assert error.code == code
        return error.message
    raise AssertionError("opened in silence")


def example(folder):
    """The files of an example, as the installed program writes them."""
    from xfemnav_cli.main import cli

    cli.main(["example", "phantom", str(folder)], standalone_mode=False)
    names = [path.name for path in folder.rglob("*") if path.is_file()]
    assert "sub-phantom_T1w.nii.gz" in names
    return f"{len(names)} files, from the package xfemnav_examples of the wheel", ""


def several_slices(folder):
    """Two slices of one volume, by a manifest, and what the table says of them."""
    from xfemnav_cli.main import cli

    write(folder / "vol.nii.gz", np.stack([brain(), brain()], axis=2))
    (folder / "slices.tsv").write_text(
        "name\timage\tslice\tcut\topening_mm\telement_size_mm\tcorridor_element_mm\n"
        f"z0\tvol.nii.gz\t0\t{CUT}\t4\t8\t4\nz9\tvol.nii.gz\t9\t{CUT}\t4\t8\t4\n")
    code = cli.main(["batch", str(folder / "slices.tsv"), str(folder / "out"), "-j2"], standalone_mode=False)
    header, *lines = (folder / "out" / "batch.tsv").read_text().splitlines()
    rows = [dict(zip(header.split("\t"), line.split("\t"), strict=True)) for line in lines]
    assert code == 1 and [row["status"] for row in rows] == ["complete", "failed"]
    assert rows[1]["error"] == "E120" and float(rows[0]["max_displacement_mm"]) > 1 and rows[1]["residual"] == "n/a"
    return "batch.tsv: z0 complete, moved by {max_displacement_mm} mm; z9 failed".format(**rows[0]), rows[1]["error"]


ROWS = [
    Row("D7", "a run, made again from what it left", "its settings stood in run.json alone", made_again),
    Row("D7", "a scenario that leads out of its folder", "no way to allow it", allowed),
    Row("D8", "the phantom of the pages", "in neither wheel nor sdist", example),
    Row("D9", "slices of one volume in a batch", "a copy of the volume each, no table", several_slices),
    Row("7", "a run moved, its image moved, changed, gone", "nothing told where the image was", moved),
]
