"""Mistakes that newcomers make: each is answered by a message that names the mistake and its mend.

The brain is one of the size of MNI152, in 12 axial slices of 2 mm; the commands are those that people type.
"""

import os
import shlex

import nibabel as nib
import numpy as np
import pytest
from small import QUICK, xfemnav

from data_synthetic import files, phantom

CUT = '--cut "-54.7,41.5 -22,18"'
OPENED = f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 6"
AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
AFFINE[:3, 3] = -71, -108, 8
SCENARIOS = {
    "a": 'xfemnav = 1\nimage = "../sub-01_T1w.nii.gz"\n',
    "b": """xfemnav = 1
image = "my data/patient 1.nii.gz"
slice_mm = 18
[[cut]]
point = [[-54.7, 41.5], [-22.0, 18.0]]
[[retract]]
side = "Left"
normal = 3
[mesh]
element_size = 2
""",
    "c": """image = "my data/patient 1.nii.gz"
[slice]
position_mm = 18
[[cut]]
points = [-54.7, 41.5, -22.0, 18.0]
[[retract]]
side = "left"
cut = "aproach"
normal_mm = "3"
""",
    "c2": """xfemnav = 1
image = "nowhere.nii.gz"
[slice]
position_mm = 18
[[cut]]
name = "approach"
points = [[-54.7, 41.5], [-22.0, 18.0]]
[[retract]]
side = "left"
cut = "aproach"
normal_mm = 3
""",
    "d": """xfemnav = 1
image = "my data/patient 1.nii.gz"
[slice]
position_mm = 18
[cut]
points = [[-54.7, 41.5], [-22.0, 18.0]]
[retract]
side = "left"
normal_mm = 3
""",
    "e": "xfemnav = 1\nimage = my data/patient 1.nii.gz\n\n",
}
#: command line, exit status, the code ("" for none), and the words that must be said of mistake and mend.
MISTAKES = [
    # which image, which slice
    (f"run sub01_T1w.nii.gz --slice-mm 18 {CUT} --opening-mm 6", 66, "E100", ["sub01_T1w", "Correct the path"]),
    (f"run mni.nii.gz {CUT} --opening-mm 6", 65, "E120", ["12 axial slices", "--slice 0 to 11", "--slice-mm 8 to"]),
    (f"run mni.nii.gz --slice-mm 180 {CUT} --opening-mm 6", 65, "E120", ["no axial slice at 180", "--slice-mm 8"]),
    (f"run mni.nii.gz --slice 900 {CUT} --opening-mm 6", 65, "E120", ["no axial slice", "index 900", "--slice 0"]),
    (f"run mni.nii.gz --volume {CUT} --opening-mm 6", 2, "", ["--volume wants N", "--cut", "4-D", "--slice-mm S"]),
    ("run mni.nii.gz --volume --cut c.mrk.json --opening-mm 6", 2, "", ["--volume wants N", "leave it out"]),
    (f"run mni.nii.gz --volume 1 {CUT} --opening-mm 6", 65, "E121", ["one volume", "leave out --volume"]),
    (f"run bold.nii.gz --slice-mm 18 {CUT} --opening-mm 6", 65, "E121", ["2 volumes", "4-D", "--volume 0 to 1"]),
    (f"run out/phantom {CUT} --opening-mm 6", 65, "E106", ["out/phantom", "folder without DICOM", "an image file"]),
    ("run out/a.toml", 78, "E780", ["out/a.toml is a scenario", "--scenario out/a.toml"]),
    (f"{OPENED} --mask {{mask}}", 65, "E204", ["grids differ", "256 x 256", "72 x 92", "--resample-mask"]),
    # where the cut is
    ('run mni.nii.gz --slice-mm 18 --cut "54.7,-41.5 22,-18" --space lps --opening-mm 6', 0, "", []),
    ('run mni.nii.gz --slice-mm 18 --cut "54.7,-41.5 22,-18" --opening-mm 6', 65, "E302",
     ["inside the organ", "did you mean --space lps"]),
    ('run mni.nii.gz --slice-mm 18 --cut "-54.7,41.5 -22,18" --space lps --opening-mm 6', 65, "E302",
     ["inside the organ", "did you mean --space ras"]),
    ('run mni.nii.gz --slice-mm 18 --cut "-120,41.5 -100,18" --opening-mm 6', 65, "E301",
     ["does not enter the organ", "mm from its first point", "--space ras|lps|voxel"]),
    ('run mni.nii.gz --slice-mm 18 --cut "-22,18 -54.7,41.5" --opening-mm 6', 65, "E302",
     ["from its tip", "give its points in the other order"]),
    ('run mni.nii.gz --slice-mm 18 --cut "43,115 60,100 76,92" --space voxel --opening-mm 6', 65, "E301",
     ["does not enter the organ", "--space"]),
    ('run mni.nii.gz --slice 5 --cut "8,74,5 16,68,5 24,63,5" --space voxel --opening-mm 6', 0, "", []),
    ('run mni.nii.gz --slice-mm 18 --cut "-54.7,41.5,20 -22,18,20" --opening-mm 6', 65, "E307",
     ["2.00 mm off", "--slice-mm 20"]),
    ("run mni.nii.gz --slice-mm 18 --cut mycut.mrk.json --opening-mm 6", 66, "E100", ["mycut.mrk.json", "Correct"]),
    ("run mni.nii.gz --slice-mm 18 --opening-mm 6", 78, "E780", ["give a cut", '--cut "x,y x,y ..."']),
    (f"run mni.nii.gz --slice-mm 18 --plane coronal {CUT} --opening-mm 6", 65, "E302", ["image ends inside the organ"]),
    # how points and vectors are written
    ('run mni.nii.gz --slice-mm 18 --cut "-54.7 41.5 -22 18" --opening-mm 6', 78, "E780",
     ["'x,y x,y ...'", 'did you mean --cut="-54.7,41.5 -22,18"']),
    ('run mni.nii.gz --slice-mm 18 --cut "(-54.7, 41.5), (-22, 18)" --opening-mm 6', 78, "E780",
     ["without brackets", 'did you mean --cut="-54.7,41.5 -22,18"']),
    ('run mni.nii.gz --slice-mm 18 --cut "-54.7, 41.5; -22, 18" --opening-mm 6', 78, "E780",
     ['did you mean --cut="-54.7,41.5 -22,18"']),
    ("run mni.nii.gz --slice-mm 18 --cut -54.7,41.5 -22,18 --opening-mm 6", 2, "",
     ["quote it", '--cut "-54.7,41.5 -22,18"']),
    ("run mni.nii.gz --slice-mm 18 --cut 54.7,-41.5 22,-18 --opening-mm 6", 2, "", ["quote it", '"54.7,-41.5 22,-18"']),
    ("run mni.nii.gz --slice-mm 18 --cut -54.7, 41.5 -22, 18 --opening-mm 6", 2, "",
     ["quote it", '--cut "-54.7,41.5 -22,18"']),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left 3.5, 1", 2, "", ["--left", "quote it", '--left "3.5,1"']),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left 3.5 -1", 2, "", ["--left", "quote it", '--left "3.5,-1"']),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 6mm", 2, "", ["6mm", "without a unit", "as 6"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 6,5", 2, "", ["decimal point", "as 6.5"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 6 mm", 2, "", ["without a unit", "--opening-mm 6"]),
    # what moves, and how far
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left=-3.5,-1 --right 3.5,1", 65, "E405",
     ["left and right look swapped", "walking from the mouth to the tip"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left 3.5,1 --right=-3.5,-1", 0, "", []),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left 3.5 --right 3.5", 0, "", []),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --left 3.5 --right=-3.5", 0, "W411", ["the right lip", "towards the other"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT}", 0, "W409", ["nothing moves", "--opening-mm"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 0.006", 0, "W409", ["nothing moves", "mm, not m", "metres"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm 60", 3, "E401", ["folds the tissue", "--opening-mm 2"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening-mm -5", 78, "E780",
     ["--opening-mm: ", "not negative", "did you mean --opening-mm 5?"]),
    (f"{OPENED} --young-kpa 3000", 0, "W408", ["mmHg", "100 mmHg", "3000 kPa", "kPa, not Pa"]),
    (f"{OPENED} --poisson 0.5", 65, "E404", ["--poisson", "0.499", "xfemnav run --help"]),
    (f"{OPENED} --left 3.5,1", 78, "E780", ["--opening-mm: moves both lips", "--left", "xfemnav run --help"]),
    (f"{OPENED} --blade 0,80", 65, "E402", ["--blade", "FROM,TO", "0,0.8"]),
    (f"{OPENED} --gravity 0,-9.81", 78, "E780", ["--gravity", "direction", "at most 1", "0,-1"]),
    ('run mni.nii.gz --slice-mm 18 --cut "-75,-5 -40,-5" --opening-mm 5', 0, "", []),
    # the program
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening 6", 2, "", ["No such option '--opening'", "mean '--opening-mm'?"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --open-mm 6", 2, "", ["No such option '--open-mm'", "mean '--opening-mm'?"]),
    (f"run mni.nii.gz --slice-mm 18 {CUT} --opening_mm 6", 2, "", ["No such option", "mean '--opening-mm'?"]),
    ("Run mni.nii.gz", 2, "", ["No such command 'Run'", "mean 'run'"]),
    ("rum mni.nii.gz", 2, "", ["No such command 'rum'", "mean 'run'"]),
    ("", 2, "", ["Commands:", "run", "--help"]),
    ("--help-all", 2, "", ["No such option '--help-all'", "'--help'"]),
    ("run --help extra", 0, "", ["--cut", "--opening-mm"]),
    (f"{OPENED} --json", 0, "", ['"status": "complete"']),
    # scenarios
    ("check out/a.toml", 78, "E781", ["stay in its folder", "'../sub-01_T1w.nii.gz'", "Move the file"]),
    ("check out/b.toml", 78, "", ["did you mean 'points'", "did you mean 'left'", "did you mean 'normal_mm'",
                                  "did you mean 'element_size_mm'", "slice_mm: unknown key", "slice.position_mm"]),
    ("check out/c.toml", 78, "", ["xfemnav = 1", "points = [[-54.7, 41.5], [-22.0, 18.0]]", "without quotes",
                                  "no cut is called 'aproach'", "'cut'"]),
    ("check out/c2.toml", 78, "E100", ["did you mean 'approach'", "nowhere.nii.gz"]),
    ("check out/d.toml", 78, "", ["[[cut]]", "[[retract]]"]),
    ("check out/e.toml", 78, "E780", ["no TOML", "line 2", 'image = "my data/patient 1.nii.gz"']),
    ("check mni.nii.gz", 78, "E780", ["mni.nii.gz", "no scenario", "xfemnav run"]),
    # where to
    ('run "out/my data/patient 1.nii.gz" --slice-mm 18 ' + CUT + ' --opening-mm 6 -o "out/my data/res 1"', 0, "", []),
    (f"{OPENED} -o mni.nii.gz", 73, "E502", ["mni.nii.gz is a file", "folder", "-o"]),
    # apply
    ("apply out/nothere sub-mni_dseg.nii.gz", 66, "E100", ["no folder out/nothere", "output folder of a run"]),
    ("apply sub-mni_dseg.nii.gz {run}", 66, "E100", ["apply {run} sub-mni_dseg.nii.gz"]),
    ("apply {run} sub-mni_dseg.nii.gz -o out/ap", 0, "", ["label image"]),
    ("apply {run} sub-mni_dseg.nii.gz -o out/ap", 73, "E731", ["exists", "--force", "-o"]),
    ("apply {run} targets.csv -o out/inverse --inverse", 0, "", ["desc-preoperative", "1 tissue"]),
    ("apply {run} sub-mni_dseg.nii.gz --inverse", 78, "E780", ["--inverse is for points"]),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder as a newcomer has it: images, a phantom, scenarios, and a run."""
    home = tmp_path_factory.mktemp("mistakes")
    x, y, z = np.indices((72, 92, 12)) * 2.0 + AFFINE[:3, 3][:, None, None, None]
    inside = (x / 68) ** 2 + ((y + 17) / 88) ** 2 + ((z - 10) / 75) ** 2 < 1
    core = ((x - 8) / 30) ** 2 + ((y + 17) / 35) ** 2 < 1
    brain = np.where(inside, 500 + 200 * core + 40 * np.sin(x / 3) * np.cos(y / 4), 0).astype(np.int16)
    (home / "out" / "my data").mkdir(parents=True)
    for name, values in {"mni.nii.gz": brain, "out/my data/patient 1.nii.gz": brain,
                         "bold.nii.gz": np.stack([brain, brain], axis=-1),
                         "sub-mni_dseg.nii.gz": (inside * (1 + core)).astype(np.uint8)}.items():
        nib.save(nib.Nifti1Image(values, AFFINE), home / name)
    mask = files.write(phantom.Phantom(), home / "out" / "phantom")["mask"]
    (home / "targets.csv").write_text("label,r,a,s\nF-1,-20,5,18\n")
    for name, text in SCENARIOS.items():
        (home / "out" / f"{name}.toml").write_text(text)
    return home, {"mask": str(mask.relative_to(home)), "run": "out/run"}


@pytest.fixture
def there(folder, monkeypatch):
    home, names = folder
    monkeypatch.chdir(home)
    monkeypatch.setenv("XFEMNAV_CACHE", str(home / "cache"))
    return names


def typed(capfd, line: str) -> tuple[int, str]:
    """Exit status of a command line, and all that it says."""
    words = shlex.split(line)
    quick = QUICK if words[:1] == ["run"] and "--help" not in words and "out/a.toml" not in words else ()
    code, out, err = xfemnav(capfd, *words, *quick)
    return code, " ".join((out + err).split())


@pytest.mark.parametrize("line, status, code, words", MISTAKES, ids=lambda x: x[:60] if isinstance(x, str) else "")
def test_a_mistake_is_named_with_its_mend(line, status, code, words, there, capfd):
    if "{run}" in line and not os.path.exists("out/run"):
        assert typed(capfd, f"{OPENED} -o out/run")[0] == 0
    found, text = typed(capfd, line.format(**there))
    assert found == status, text
    for word in [code, *words]:
        assert word.format(**there) in text, f"{word} is not in: {text}"
    if not code and status == 0 and line.startswith("run"):
        assert not [word for word in text.split() if word[:2] in ("W1", "W2", "W3", "W4")], text


def test_nothing_is_said_twice(there, capfd):
    for line, *_ in MISTAKES:
        _, text = typed(capfd, line.format(**there))
        for sentence in text.split(". "):
            assert len(sentence) < 25 or text.count(sentence) == 1, f"{line}: {sentence}"
        assert "?. " not in text and ".. " not in text.replace("...", ""), line
