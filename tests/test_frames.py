"""One phantom in every storage order, on straight and oblique grids, in every format: one physical answer.

The phantom lies in the slice's plane, which is turned about (1, 1, 1); its motion is known. Within a grid nothing but
rounding may differ (headers of NIfTI-1 and MGH hold float32, 4e-6 mm at 100 mm). Point files of every kind and frame
draw the same cut, and what lies off the slice, or in the wrong frame, is told.
"""

import json
from functools import lru_cache

import numpy as np
import pytest
from small import CUT, OPEN, QUICK, RAS, write, xfemnav

from data_synthetic.phantom import Grid, Phantom, boundary_displacement, cut_path, landmarks, perfect_solution
from tests.images import ORDERS, image_of, stored
from tests.motions import turned
from tests.test_dicom import write_series
from tests.test_formats import write as write_volume
from xfemnav.geometry.motion import Motion
from xfemnav.imaging.carrying.landmarks import moved_points
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.slices import take_slice, to_nifti
from xfemnav.imaging.points.point_files import PointSet, read_points, write_points
from xfemnav.imaging.reading.gate import read_image

# The phantom's grid, the thickness of slices in mm, the turn in degrees.
GRIDS = {"isotropic": (Grid((152, 178), (1.1, 1.1)), 1.1, 0.0),
         "anisotropic": (Grid((120, 230), (1.4, 0.85)), 3.0, 0.0),
         "oblique 7": (Grid((168, 150), (1.0, 1.3)), 2.0, 7.0), "oblique 25": (Grid((140, 196), (1.2, 1.0)), 2.5, 25.0)}
FORMATS = ["v.nii", "v.nrrd", "v.mgz"]
MIDDLE = 12.5  # mm of the phantom's slice along the plane's normal; one slice above and one below show something else
REST, MOVED = perfect_solution(Phantom(), 360, 30)
MOTION = Motion(REST, MOVED, (cut_path(),))


@lru_cache
def volume(name: str):
    """Three slices, the phantom in the middle in whole numbers, and the brain mask of the middle one."""
    grid, thickness, degrees = GRIDS[name]
    axes = np.eye(3) @ turned(degrees).T  # rows e1, e2, normal
    phantom = Phantom(grid=grid)
    middle = np.round(phantom.image())
    affine = np.eye(4)
    affine[:3, :3] = axes.T * (*grid.spacing, thickness)
    affine[:3, 3] = [*grid.origin, MIDDLE - thickness] @ axes
    mask = np.stack([phantom.mask] * 3, axis=-1).astype(float)
    return image_of(np.stack([middle[::-1], middle, middle[:, ::-1]], axis=-1), affine), image_of(mask, affine)


def middle_of(image):
    return take_slice(image, plane="axial", position_mm=MIDDLE)


def warped(slice):
    """The slice after the phantom's motion."""
    grid = slice.origin, slice.spacing, slice.values.shape
    return update(slice.values, covered(REST, *grid), pull_back(REST, MOVED, *grid))


def shown_at(image, points):
    """Values (n,) of a nibabel image at points (n, 3) RAS mm that are voxels' centres, to 1e-3 voxels."""
    voxels = points @ np.linalg.inv(image.affine)[:3, :3].T + np.linalg.inv(image.affine)[:3, 3]
    nearest = np.rint(voxels).astype(int)
    assert abs(voxels - nearest).max() < 1e-3
    return np.asarray(image.dataobj)[tuple(nearest.T)]


@lru_cache
def truth(name: str):
    """World places (n, 3) of the pixels, their updated values (n,), and the landmarks (20, 3) at rest and moved."""
    slice = middle_of(volume(name)[0])
    at = slice.to_world(slice.pixel_centres().reshape(-1, 2))
    return at, warped(slice).updated.ravel(), slice.to_world(landmarks()), moved(slice, slice.to_world(landmarks()))


def moved(slice, points):
    return moved_points(points, slice, MOTION, REST).moved


def assert_same(path, name: str, folder):
    """The file at `path` gives the updated image and the moved landmarks of the grid."""
    at, values, rest, now = truth(name)
    slice = middle_of(read_image(path))
    written = to_nifti(slice, warped(slice).updated)
    assert abs(shown_at(written, at) - values).max() < 1e-4 * values.max()
    write_points(folder / "landmarks.mrk.json", PointSet("Fiducial", "F", rest, ("",) * len(rest)))
    found = moved(slice, read_points(folder / "landmarks.mrk.json").points)
    assert abs(found - now).max() < 1e-6


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("name", FORMATS)
def test_every_storage_order_gives_the_same_physical_image(tmp_path, grid, name):
    """Rows 13 and 14 of the list of faults: left-handed and oblique storage are no faults."""
    for order in ORDERS:
        assert_same(write_volume(stored(volume(grid)[0], *order), tmp_path / name, np.int16), grid, tmp_path)


SHORT = [order for order in ORDERS if order[0][2] == 2]  # three files a series; else one for each row of pixels


@pytest.mark.parametrize("grid, orders", [(name, SHORT) for name in GRIDS] + [("oblique 25", ORDERS[20:23])]
                         + [pytest.param(name, ORDERS, marks=pytest.mark.slow) for name in GRIDS])
def test_every_order_of_a_dicom_series_gives_the_same_physical_image(tmp_path, grid, orders):
    for number, order in enumerate(orders):
        assert_same(write_series(stored(volume(grid)[0], *order), tmp_path / str(number)), grid, tmp_path)


def test_landmarks_are_where_the_motion_takes_them():
    """What every order gives is also right: chords of the motion over triangles of 4 mm."""
    for name in GRIDS:
        slice, (_, _, rest, now) = middle_of(volume(name)[0]), truth(name)
        exact = slice.to_world(landmarks() + Phantom().displacement(landmarks()))
        assert abs(now - exact).max() < 0.03 < abs(now - rest).max()


# Whole runs -----------------------------------------------------------------------------------------------------------

# Two files of each grid, and how far their landmarks may be apart, mm: 1e-6, or what float32 loses at 100 mm in a
# header (NIfTI, MGH) beside one in full (NRRD) when the spacings are no short binary fractions.
PAIRS = {"isotropic": ("v.nii.gz", ORDERS[0], "v.mgz", ORDERS[13], 1e-6),
         "anisotropic": ("v.nrrd", ORDERS[2], "v.nii.gz", ORDERS[43], 4e-6),
         "oblique 7": ("v.nii.gz", ORDERS[0], "series", ORDERS[9], 1e-6),
         "oblique 25": ("v.mha", ORDERS[31], "v.mgz", ORDERS[22], 1e-6)}


def put(image, path, dtype):
    """`image` in the format of the path's name; a folder of DICOM files where it has no ending."""
    return write_series(image, path) if not path.suffix else write_volume(image, path, dtype)


def run_of(name, folder, file, order, capfd):
    """The updated image's pixels (n,) and the moved landmarks (20, 3) of a whole run, cut and landmarks as markups."""
    image, mask = volume(name)
    slice = middle_of(image)
    folder.mkdir()
    path = put(stored(image, *order), folder / file, np.int16)
    mask = write_volume(stored(mask, *ORDERS[17]), folder / "mask.nii.gz", np.uint8)
    write_points(folder / "cut.mrk.json", PointSet("Line", "F", slice.to_world(cut_path()), ("", "")))
    write_points(folder / "landmarks.mrk.json", PointSet("Fiducial", "F", truth(name)[2], ("",) * 20))
    np.savetxt(folder / "boundary.csv", boundary_displacement(Phantom()), fmt="%.12g", delimiter=",",
               header="x,y,ux,uy,side", comments="")
    code, stdout, stderr = xfemnav(
        capfd, "run", path, "--plane", "axial", "--slice-mm", MIDDLE, "--mask", mask, "--cut", folder / "cut.mrk.json",
        "--points", folder / "landmarks.mrk.json", "--boundary-displacement", folder / "boundary.csv",
        "-o", folder / "out", "-w", folder.parent / "cache", "--no-report", "--json")
    assert code == 0, stderr
    outputs = json.loads(stdout)["outputs"]
    updated = read_image(folder / "out" / outputs["updated"])
    found = read_points(folder / "out" / outputs["points"]).points
    at = truth(name)[0]
    voxels = np.rint((at - updated.affine[:3, 3]) @ np.linalg.inv(updated.affine[:3, :3]).T).astype(int)
    return updated.values[tuple(voxels.T)], found


def pair_of(name, folder, capfd):
    """Landmarks (20, 2) plane mm after two whole runs of a grid, in two formats and orders, which must agree."""
    a, first, b, second, tolerance = PAIRS[name]
    folder.mkdir(exist_ok=True)
    values, points = run_of(name, folder / "a", a, first, capfd)
    others, there = run_of(name, folder / "b", b, second, capfd)
    assert abs(values - others).max() < 1e-4 * values.max()
    assert abs(points - there).max() < tolerance
    plane = middle_of(volume(name)[0]).from_world(points)[0]
    # measured .013 mm; elements of 1 mm in the corridor and 3 mm elsewhere
    assert abs(plane - landmarks() - Phantom().displacement(landmarks())).max() < 0.03
    return plane


def test_an_oblique_slice_as_nifti_and_as_dicom_series_gives_the_same_run(tmp_path, capfd):
    pair_of("oblique 7", tmp_path, capfd)


@pytest.mark.slow
def test_grids_agree(tmp_path, capfd):
    """Row 16: eight runs. Other pixels, outlines and meshes, the same tissue to a tenth of a mm (measured .004)."""
    found = [pair_of(name, tmp_path / name.replace(" ", "-"), capfd) for name in PAIRS]
    assert max(abs(one - other).max() for one in found for other in found) < 0.1


# Point files in a run -------------------------------------------------------------------------------------------------

CUT_POINTS = np.array([[-60.0, 10, 10], [-15, 5, 10]])  # RAS mm, as the flag's


def slicer(points, frame, kind="Line", signs=None) -> str:
    """Markups as Slicer saves them: `points` RAS mm in the `frame` that the file states."""
    signs = signs or {"RAS": (1, 1, 1), "LPS": (-1, -1, 1)}[frame]
    items = [{"id": str(k), "label": f"F-{k}", "description": "", "associatedNodeID": "", "position": place,
              "orientation": [-1.0, -0.0, -0.0, -0.0, -1.0, -0.0, 0.0, 0.0, 1.0], "selected": True, "locked": False,
              "visibility": True, "positionStatus": "defined"}
             for k, place in enumerate((np.asarray(points) * signs).tolist(), 1)]
    return json.dumps({"@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/"
                       "Resources/Schema/markups-schema-v1.0.3.json#", "markups": [
                           {"type": kind, "coordinateSystem": frame, "coordinateUnits": "mm", "locked": False,
                            "fixedNumberOfControlPoints": False, "labelFormat": "%N-%d",
                            "lastUsedControlPointNumber": 2, "controlPoints": items, "measurements": [],
                            "display": {"visibility": True, "opacity": 1.0}}]})


FILES = {"lps.mrk.json": slicer(CUT_POINTS, "LPS"), "ras.mrk.json": slicer(CUT_POINTS, "RAS"),
         "lps.fcsv": "# Markups fiducial file version = 4.13\n# CoordinateSystem = LPS\n"
                     "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
                     "1,60,-10,10,0,0,0,1,1,1,0,F-1,,\n2,15,-5,10,0,0,0,1,1,1,0,F-2,,\n",
         "old.fcsv": "# Markups fiducial file version = 4.10\n# CoordinateSystem = 0\n# columns = id,x,y,z,label\n"
                     "1,-60,10,10,F-1\n2,-15,5,10,F-2\n",
         "ants.csv": "x,y,z,t\n60,-10,10,0\n15,-5,10,0\n", "ras.csv": "r,a,s,label\n-60,10,10,mouth\n-15,5,10,tip\n",
         "slicer.csv": "label,l,p,s,defined,selected,visible,locked,description\nF-1,60,-10,10,1,1,1,0,\n"
                       "F-3,0,0,0,0,1,1,0,\nF-2,15,-5,10,1,1,1,0,\n",
         "slicer.tsv": "label\tr\ta\ts\tdefined\nF-1\t-60\t10\t10\t1\nF-2\t-15\t5\t10\t1\nF-3\t0\t0\t0\t0\n",
         "minc.tag": 'MNI Tag Point File\nVolumes = 1;\n\nPoints =\n -60 10 10 "mouth"\n -15 5 10 "tip";\n'}


@pytest.fixture
def head(tmp_path, monkeypatch):
    """A folder with a small brain in an axial slice of 2 mm at z = 10 mm."""
    monkeypatch.chdir(tmp_path)
    return write(tmp_path / "head.nii.gz")


def run(capfd, *arguments):
    """The record of a run of the small brain."""
    code, stdout, _ = xfemnav(capfd, "run", "head.nii.gz", *QUICK, *arguments, "-o", "out", "-w", "cache", "--json")
    record = json.loads(stdout)
    assert code == record["exit_code"]
    return record


def test_every_point_file_draws_the_same_cut(head, capfd):
    """The same problem in every stage, so that after the first run all is cached."""
    wanted = run(capfd, *OPEN, "--cut", CUT)
    for name, text in FILES.items():
        (head.parent / name).write_text(text)
        record = run(capfd, *OPEN, "--cut", name)
        assert np.allclose(record["cuts"][0]["path"], wanted["cuts"][0]["path"], atol=1e-9), name
        assert name == "lps.mrk.json" or {stage["status"] for stage in record["stages"]} == {"cached"}, name


@pytest.mark.parametrize("name", FILES)
def test_every_point_file_moves_the_same_landmarks(head, capfd, name):
    """Landmarks come back in the file's own format, and where the markups' went."""
    found = []
    for file in ("ras.mrk.json", name):
        (head.parent / file).write_text(FILES[file].replace("60", "20"))
        record = run(capfd, *OPEN, "--cut", CUT, "--points", file)
        assert record["points"] == [{"file": file, "n": 2, "tissue": 1, "on_a_cut": 1, "resected": 0, "outside": 0}]
        found.append(read_points(head.parent / "out" / record["outputs"]["points"]).points)
        assert record["outputs"]["points"].endswith(file[file.index("."):])
    np.testing.assert_allclose(*found, atol=1e-9)


ELECTRODES = "name\tx\ty\tz\nLA1\t-20\t10\t10\nLA2\tn/a\tn/a\tn/a\nLA3\t-15\t5\t10\n"


def test_electrodes_move_in_the_frame_that_stands_beside_them_or_are_doubted(head, capfd):
    (head.parent / "sub-1_electrodes.tsv").write_text(ELECTRODES)
    places = []
    for code in ("W131", None):
        record = run(capfd, *OPEN, "--cut", CUT, "--points", "sub-1_electrodes.tsv")
        assert record["points"][0] | {"file": ""} == {"file": "", "n": 2, "tissue": 1, "on_a_cut": 1, "resected": 0,
                                                       "outside": 0}
        told = [item["text"] for item in record["warnings"] if item["code"] == "W131"]
        assert len(told) == (code is not None) and all("coordsystem.json" in text for text in told)
        text = (head.parent / "out" / record["outputs"]["points"]).read_text()
        assert text.startswith("name\tx\ty\tz\nLA1\t") and "LA2" not in text
        places.append(read_points(head.parent / "out" / record["outputs"]["points"]).points)
        (head.parent / "sub-1_coordsystem.json").write_text(
            '{"iEEGCoordinateSystem": "ScanRAS", "iEEGCoordinateUnits": "mm"}')
    np.testing.assert_array_equal(*places)
    code, _, told = xfemnav(capfd, "apply", "out", "sub-1_electrodes.tsv", "-o", "later")
    assert code == 0 and "W131" not in told
    (head.parent / "sub-1_coordsystem.json").write_text('{"EEGCoordinateSystem": "CTF"}')  # no result of before
    assert run(capfd, *OPEN, "--cut", CUT, "--points", "sub-1_electrodes.tsv")["error"]["code"] == "E308"


def test_a_cut_whose_table_does_not_say_its_frame_is_refused(head, capfd):
    (head.parent / "cut.tsv").write_text("x\ty\tz\n-60\t10\t10\n-15\t5\t10\n")
    code, stdout, _ = xfemnav(capfd, "run", "head.nii.gz", *QUICK, *OPEN, "--cut", "cut.tsv", "--json")
    assert (code, json.loads(stdout)["error"]["code"]) == (65, "E308")


def test_a_table_draws_a_resection(head, capfd):
    (head.parent / "out.tsv").write_text("r\ta\ts\n" + "".join(f"{x}\t{y}\t10\n" for x, y in
                                                             ((5, 5), (25, 5), (25, 25), (5, 25))))
    record = run(capfd, "--resect", "out.tsv")
    assert record["resections"][0]["area_mm2"] == pytest.approx(400, rel=0.01)


def test_apply_doubts_landmarks_as_a_run_does(aside, capfd):
    """A file that says RAS and counts LPS, and one that lies off the slice."""
    run(capfd, *OPEN, "--cut", "20,90 65,85")
    points = np.array([[80.0, 80, 10], [90, 90, 10], [70, 100, 10]])
    (aside / "p.mrk.json").write_text(slicer(points, "RAS", "Fiducial", (-1, -1, 1)))
    (aside / "q.mrk.json").write_text(slicer(points + np.array([0, 0, 5]), "RAS", "Fiducial"))
    _, _, told = xfemnav(capfd, "apply", "out", "p.mrk.json", "q.mrk.json", "-o", "later")
    assert "p.mrk.json: W131" in told and "q.mrk.json: W132" in told and told.count("W13") == 2


@pytest.mark.parametrize("off, code", [(0.99, None), (-0.99, None), (1.02, "E307"), (-7.5, "E307")])
def test_a_cut_off_the_slice_is_refused_with_its_distance(head, capfd, off, code):
    """The slice is 2 mm thick."""
    (head.parent / "cut.mrk.json").write_text(slicer(CUT_POINTS + np.array([[0, 0, 0], [0, 0, off]]), "LPS"))
    record = run(capfd, *OPEN, "--cut", "cut.mrk.json")
    assert (record.get("error") or {"code": None})["code"] == code
    assert code is None or f"{off:.2f} mm off" in record["error"]["text"]


@pytest.fixture
def aside(head):
    """The brain 80 mm to the right and front: about the origin, x and y may change sign and nobody can tell."""
    affine = RAS.copy()
    affine[:2, 3] += 80
    return write(head, affine=affine).parent


def test_a_cut_in_the_wrong_frame_is_told(aside, capfd):
    """LPS numbers on the command line, and in a file that says RAS."""
    (aside / "cut.mrk.json").write_text(slicer(CUT_POINTS + np.array([80, 80, 0]), "RAS", signs=(-1, -1, 1)))
    for cut in ("-20,-90 -65,-85", "cut.mrk.json"):
        record = run(capfd, *OPEN, "--cut", cut)
        assert record["error"]["code"] == "E301" and "--space lps" in record["error"]["text"], cut


@pytest.mark.parametrize("frame, signs, codes", [("RAS", None, set()), ("LPS", None, set()),
                                                 ("RAS", (-1, -1, 1), {"W131"}), ("LPS", (1, 1, 1), {"W131"})])
def test_landmarks_in_the_wrong_frame_are_told(aside, capfd, frame, signs, codes):
    points = np.array([[80.0, 80, 10], [90, 90, 10], [70, 100, 10]])
    (aside / "p.mrk.json").write_text(slicer(points, frame, "Fiducial", signs))
    record = run(capfd, *OPEN, "--cut", "20,90 65,85", "--points", "p.mrk.json")
    told = [item for item in record["warnings"] if item["code"] in ("W131", "W132")]
    assert {item["code"] for item in told} == codes
    assert all("3 with x and y negated" in item["text"] for item in told)


def test_landmarks_off_the_slice_are_told(head, capfd):
    points = np.array([[0.0, 0, 10.9], [5, 5, 11.1], [9, 9, -20]])
    (head.parent / "p.mrk.json").write_text(slicer(points, "LPS", "Fiducial"))
    for _ in ("run", "cached"):
        record = run(capfd, *OPEN, "--cut", CUT, "--points", "p.mrk.json")
        told = [item["text"] for item in record["warnings"] if item["code"] == "W132"]
        assert len(told) == 1 and "2 of 3 points" in told[0] and "up to 30.00 mm" in told[0]
