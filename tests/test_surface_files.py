"""Files of surfaces: what others write is read where it says that it lies, comes back in kind, or is refused."""

import base64
import lzma
import re
import struct
import warnings
import zlib

import meshio
import nibabel
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.fuzz.surface_seeds import FACES, POINTS, SEEDS, STRIPS, STRIPS_XML, gii, ply, vtk, vtp
from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.endings import SURFACES, ending_of
from xfemnav.imaging.points.surface_files import decoded_surface, read_surface

LPS = np.array([-1.0, -1.0, 1.0])
SHIFT = np.array([1.0, 2, 3])
FLOAT32 = 1e-5    # mm, of 100


def corners(surface, points=None, kept=slice(None)):
    """The corners (m, 3, 3) of triangles, however points are numbered."""
    points = surface.points if points is None else points
    return np.asarray(points)[surface.corners.reshape(-1, 3)[kept]]


@pytest.mark.parametrize("name", SEEDS)
def test_every_format_is_read_and_comes_back(name):
    surface = decoded_surface(SEEDS[name], name.split("/")[-1])
    expected = POINTS * LPS if "lps" in name else POINTS
    assert_allclose(corners(surface), expected[FACES], atol=FLOAT32)
    kept = np.array([True, False, True, True])
    made = surface.written(surface.points + SHIFT, kept)
    again = decoded_surface(made, name.split("/")[-1])
    assert_allclose(corners(again), expected[FACES][kept] + SHIFT, atol=FLOAT32)
    assert again.frame == surface.frame and again.stated == surface.stated
    if ".stl" not in name:    # whose points are the corners of its faces
        assert_allclose(again.points, surface.points + SHIFT, atol=FLOAT32)
    same = decoded_surface(surface.written(surface.points, np.ones(4, bool)), name.split("/")[-1])
    assert_array_equal(same.points, surface.points)
    assert made == surface.written(surface.points + SHIFT, kept)    # equal surfaces are equal files


@pytest.mark.parametrize("name", [name for name in SEEDS if ".obj" not in name])
def test_a_file_that_ends_early_is_refused_wherever_it_ends(name):
    """Text that ends between two lines of faces is whole to OBJ."""
    whole = SEEDS[name].rstrip()
    for n in {0, 1, 3, 80, 84, *range(len(whole) // 2, len(whole) - 30, 7), len(whole) - 30} - {len(whole)}:
        try:
            found = decoded_surface(whole[:n], name.split("/")[-1])
        except XfemnavError as error:
            assert error.code == "E701"
        else:    # a solid may be the last, and so may what is said of points and faces, each part for itself
            if name == "ascii.stl":
                assert b"endsolid" in whole[:n].splitlines()[-1]
                continue
            assert name.endswith(("full.vtk", "binary/lps.vtk")) and n > whole.rindex(b"POLYGONS") + 40
            assert_allclose(corners(found), corners(decoded_surface(whole, name.split("/")[-1])))


def test_a_frame_is_the_files_own_before_that_of_its_user():
    for space in ("ras", "lps", "voxel"):
        told = decoded_surface(vtk(title="3D Slicer output. SPACE=LPS"), "a.vtk", space)
        assert told.stated and told.frame == "LPS as the file says"
        assert_allclose(told.points, POINTS * LPS, atol=FLOAT32)
        silent = decoded_surface(vtk(), "a.vtk", space)
        assert not silent.stated and silent.frame == f"{'LPS' if space == 'lps' else 'RAS'} as space says"
        assert_allclose(silent.points, POINTS * (LPS if space == "lps" else 1), atol=FLOAT32)
    with pytest.raises(XfemnavError, match=r"E701.*both"):
        decoded_surface(vtk(title="SPACE=LPS SPACE=RAS"), "a.vtk")


def test_freesurfers_centre_is_added_and_taken_off_again():
    centre = np.array([5.2, -17.6, 20.4])
    about = {f"VolGeomC_{axis}": str(x) for axis, x in zip("RAS", centre)}
    surface = decoded_surface(gii(about=about), "lh.pial.gii")
    assert "(5.20, -17.60, 20.40)" in surface.frame and surface.stated
    assert_allclose(surface.points, POINTS + centre, atol=FLOAT32)
    made = nibabel.gifti.GiftiImage.from_bytes(surface.written(surface.points, np.ones(4, bool)))
    assert_array_equal(made.agg_data("pointset"), POINTS.astype("f4"))    # to the bit
    assert dict(made.darrays[0].meta)["VolGeomC_R"] == "5.2"
    # a volume that is not stored as FreeSurfer conforms one: its axes are turned too
    turn = np.array([[0.96, -0.28, 0], [0.28, 0.96, 0], [0, 0, 1]])
    axes = turn @ np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    turned = about | {f"VolGeom{column}_{axis}": str(axes[i, j]) for j, column in enumerate("XYZ")
                      for i, axis in enumerate("RAS")}
    assert_allclose(decoded_surface(gii(about=turned), "a.gii").points, POINTS @ turn.T + centre, atol=FLOAT32)
    for bad in ({"VolGeomX_R": "3"}, {"VolGeomC_R": "none"}):
        with pytest.raises(XfemnavError, match="E701"):
            decoded_surface(gii(about=turned | bad), "a.gii")


def test_spaces_of_gifti():
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    assert_allclose(decoded_surface(gii(target=1, matrix=matrix), "a.gii").points, POINTS + SHIFT, atol=FLOAT32)
    about = {f"VolGeomC_{axis}": x for axis, x in zip("RAS", "123")}
    assert decoded_surface(gii(target=1, matrix=matrix, about=about), "a.gii").stated
    with pytest.raises(XfemnavError, match=r"E701.*says twice"):
        decoded_surface(gii(target=1, matrix=matrix, about=about | {"VolGeomC_R": "9"}), "a.gii")
    for space in (1, 2, 3, 4):
        assert_allclose(decoded_surface(gii(space=space, about=about), "a.gii").points, POINTS, atol=FLOAT32)
    with pytest.warns(match="W112"):
        assert_allclose(decoded_surface(gii(), "a.gii", "lps").points, POINTS, atol=FLOAT32)


def test_what_else_a_file_says_is_kept_and_normals_are_not():
    kept = np.array([False, True, True, False])

    def made(content, name):
        surface = decoded_surface(content, name)
        return surface.written(surface.points, kept)

    text = made(SEEDS["ascii/lps.vtp"], "a.vtp").decode()
    assert ">2 3<" in text.replace("\n", "") and "Normals" not in text and "curvature" in text and "SPACE" in text
    legacy = made(SEEDS["ascii/full.vtk"], "a.vtk").decode()
    assert "id 1 2 int\n2\n3\n" in legacy and "NORMALS" not in legacy and "LOOKUP_TABLE mine 1" in legacy
    assert "SCALARS curvature float 1\nLOOKUP_TABLE default\n0.0\n1.0\n2.0\n3.0\n4.0\n" in legacy
    text = made(SEEDS["ascii/lps.ply"], "a.ply").decode()
    assert "comment SPACE=LPS" in text and "element face 2" in text and " nx" not in text
    assert text.splitlines()[-2:] == ["3 0 2 3 20", "3 0 3 1 30"] and text.splitlines()[-7].endswith(" 200")
    text = made(SEEDS["lps.obj"], "a.obj").decode()
    assert "usemtl skin\n" in text and "vt 0.5 0.5\n" in text and "vn" not in text and "f 1/1 3/1 4/1\n" in text
    binary = made(SEEDS["binary/lps.stl"], "a.stl")
    assert binary[:80].startswith(b"3D Slicer output. SPACE=LPS") and len(binary) == 84 + 2 * 50
    assert [struct.unpack_from("<H", binary, 84 + 50 * k + 48)[0] for k in (0, 1)] == [7, 8]
    a, b, c = np.frombuffer(binary, "<f4", 9, 84 + 12).reshape(3, 3).astype(float)
    normal = np.cross(b - a, c - a)
    assert_allclose(np.frombuffer(binary, "<f4", 3, 84), normal / np.linalg.norm(normal), atol=1e-6)
    text = made(SEEDS["ascii.stl"], "a.stl").decode()
    assert text.startswith("solid one\n") and text.count("facet normal") == 2 and "endsolid two" in text


def test_strips_become_triangles_that_share_what_is_said_of_them():
    for name, content in (("a.vtk", STRIPS), ("a.vtp", STRIPS_XML)):
        surface = decoded_surface(content.encode(), name)
        normal = np.cross(*(corners(surface)[:, k] - corners(surface)[:, 0] for k in (1, 2)))
        assert len(surface.count) == 4 and (normal[:, 2] > 0).all()    # all turned alike
        made = surface.written(surface.points, np.array([True, True, False, True]))
        assert len(decoded_surface(made, name).count) == 3
        assert b"5 5 6" in made.replace(b"\n", b" ")    # the numbers of the two strips


def test_what_is_sound_but_not_read_is_no_damage():
    lz4 = vtp("binary").replace(b"<VTKFile ", b'<VTKFile compressor="vtkLZ4DataCompressor" ')
    grid = vtk().replace(b"POLYDATA", b"UNSTRUCTURED_GRID")
    tables = {
        "a.vtp": [(lz4, "vtkLZ4DataCompressor.*ZLib"), (vtp("ascii").replace(b"PolyData", b"ImageData"), "ImageData"),
                  (vtp("ascii").replace(b"</PolyData>", b"<Piece/></PolyData>"), "2 pieces")],
        "a.vtk": [(grid, "UNSTRUCTURED_GRID.*POLYDATA")],
        "a.gii": [(gii(triangles=2), "one of each")],
    }
    for name, rows in tables.items():
        for content, told in rows:
            with pytest.raises(XfemnavError, match=f"E701.*{told}") as caught:
                decoded_surface(content, name)
            assert "damaged" not in str(caught.value)
    for name, content, told in (("a.stl", ply(), "is no .stl: its content is that of a .ply"),
                                ("a.vtk", b"hello", "does not begin with '# vtk DataFile'"),
                                ("a.obj", vtp("ascii"), "content is that of a .vtp")):
        with pytest.raises(XfemnavError, match=re.escape(told)) as caught:
            decoded_surface(content, name)
        assert "damaged" not in str(caught.value)
    with pytest.raises(XfemnavError, match=r"E701.*\.stl, \.vtk, \.vtp"):
        decoded_surface(b"x", "lh.pial")


def test_what_cannot_be_is_refused():
    for bad, told in ((np.inf, "NaN or infinite"), (np.nan, "NaN or infinite"), (2e5, "units")):
        points = POINTS.copy()
        points[2, 1] = bad
        for name, content in (("a.vtk", vtk(points)), ("a.ply", ply(points)), ("a.vtp", vtp("binary", points=points))):
            with pytest.raises(XfemnavError, match=f"E701.*{told}"):
                decoded_surface(content, name)
    for name, content in (("a.vtk", vtk(faces=FACES + 3)), ("a.ply", ply(faces=FACES + 3)),
                          ("a.vtp", vtp("ascii", faces=FACES - 1)), ("a.obj", b"v 1 2 3\nf 1 1 9\n")):
        with pytest.raises(XfemnavError, match=r"E701.*does not hold"):
            decoded_surface(content, name)
    for name, content in (("a.obj", b"v 1 2\nv 2 1\nv 1 1\n"), ("a.obj", b"# nothing\n"),
                          ("a.stl", b"solid x\nendsolid x\n"), ("a.obj", b"v 1 2 3\nf 0 1 1\n"),
                          ("a.ply", b"ply\nformat ascii 1.0\nend_header\n")):
        with pytest.raises(XfemnavError, match="E701"):
            decoded_surface(content, name)


@pytest.mark.parametrize("name, number", [
    ("ascii/full.vtk", "POINTS 5 float"), ("ascii/full.vtk", "SCALARS curvature float"),
    ("ascii/full.vtk", "NORMALS Normals float"), ("binary/lps.vtk", "OFFSETS vtktypeint64"),
    ("binary/lps.vtk", "CONNECTIVITY vtktypeint64"), ("binary/lps.vtk", "POINTS 5 double")])
def test_texts_where_numbers_belong_are_refused(name, number):
    content, number = SEEDS[name], number.encode()
    assert content.count(number) == 1
    with pytest.raises(XfemnavError, match=r"E701.*array of type string"):
        decoded_surface(content.replace(number, number.rpartition(b" ")[0] + b" string"), "a.vtk")


@pytest.mark.parametrize("line", [b"v 14 24 7 1 \\ ", b"f 1/1/1 2/1/1 3/\\/1"])
def test_a_line_that_is_written_anew_does_not_go_on_in_the_next(line):
    """A backslash that ends it once its blanks or normals are gone would take the next line along."""
    text = b"\n".join([b"v 10 20 5", b"v 14 20 6", b"v 14 24 7", line, b"f 1 2 3", b"f 3 2 1", b""])
    read = decoded_surface(text, "a.obj")
    again = decoded_surface(read.written(read.points, np.ones(len(read.count), bool)), "a.obj")
    assert_array_equal(again.corners, read.corners)
    assert_array_equal(again.points, read.points)


@pytest.mark.parametrize("matrix", [b"1 2 3", b"1.0#0 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", b"nan"])
def test_a_gifti_whose_matrix_of_coordinates_is_damaged_is_refused(matrix):
    """Of the points or the faces: it is written back, which a broken one cannot be."""
    for content in (re.sub(b"<MatrixData>[^<]*", b"<MatrixData>" + matrix, gii(), count=k) for k in (1, 2)):
        with pytest.raises(XfemnavError, match=r"E701"):
            decoded_surface(content, "a.gii")


@pytest.mark.parametrize("place", ["CELL_DATA 4\n", "DATASET POLYDATA\n"])
def test_texts_without_end_are_refused_at_the_end(place):
    """Not after as many empty ones as the file says."""
    text = SEEDS["ascii/full.vtk"].decode("latin-1")
    endless = text.replace(place, f"{place}FIELD FieldData 1\nSPACE 1 999999999999 string\nLPS\n", 1)
    with pytest.raises(XfemnavError, match=r"E701.*ends in a text"):
        decoded_surface(endless.encode("latin-1"), "a.vtk")


def test_a_facet_that_does_not_end_takes_no_solid_with_it():
    """The lines of solids would be lost with it when the facet is written anew."""
    facet = b"facet normal 0 0 1\n outer loop\n"
    text = SEEDS["ascii.stl"]
    second, end = text.index(facet, text.index(facet) + 1), text.index(b"endsolid one")
    with pytest.raises(XfemnavError, match=r"E701.*damaged STL text"):
        decoded_surface(text[:second] + facet + text[end:], "a.stl")


@pytest.mark.parametrize("packer", [("vtkZLibDataCompressor", zlib.compress), ("vtkLZMADataCompressor", lzma.compress)])
def test_what_unpacks_to_too_much_is_refused_unread(packer):
    name, pack = packer
    block = pack(bytes(3 << 20))
    n = (3 << 20) // 24 * 200
    head = struct.pack(f"<3I{200}I", 200, 3 << 20, 0, *[len(block)] * 200)
    data = base64.b64encode(head) + base64.b64encode(block * 200)
    content = (f'<VTKFile type="PolyData" compressor="{name}"><PolyData><Piece NumberOfPoints="{n}" NumberOfPolys="0">'
               '<Points><DataArray type="Float64" NumberOfComponents="3" format="binary">').encode() + data + (
               b"</DataArray></Points></Piece></PolyData></VTKFile>")
    with pytest.raises(XfemnavError, match="E102"):
        decoded_surface(content, "bomb.vtp")
    gifti = gii().replace(b"GZipBase64Binary", b"GZipBase64Binary", 1)
    start = gifti.index(b"<Data>") + 6
    bomb = gifti[:start] + base64.b64encode(zlib.compress(bytes(40_000_000))) + gifti[gifti.index(b"</Data>"):]
    with pytest.raises(XfemnavError, match="E102"):
        decoded_surface(bomb, "bomb.gii")


def test_nothing_is_opened_and_no_entity_followed():
    entity = b'<!DOCTYPE x [<!ENTITY a "aaaa">]>'
    for name, content in (("a.vtp", vtp("ascii")), ("a.gii", gii())):
        with pytest.raises(XfemnavError, match="E701"):
            decoded_surface(content.replace(b"?>", b"?>" + entity, 1), name)
    with pytest.raises(XfemnavError, match=r"E701.*another file"):
        decoded_surface(gii().replace(b'ExternalFileName=""', b'ExternalFileName="/etc/passwd"', 1), "a.gii")


def test_meshio_reads_what_is_written(tmp_path):
    """Another program's reader, of the formats that it has."""
    kept = np.array([True, False, True, False])    # meshio does not count back, as the last face of the .obj does
    for name in ("binary/lps.stl", "ascii.stl", "lps.obj", "ascii/lps.ply"):
        # meshio takes texture coordinates for data of points
        surface = decoded_surface(SEEDS[name].replace(b"vt 0.5 0.5\n", b""), name.split("/")[-1])
        path = tmp_path / name.replace("/", "-")
        path.write_bytes(surface.written(surface.points, kept))
        found = getattr(meshio, path.suffix[1:]).read(path)
        own = found.points[:, :3] * (LPS if "lps" in name else 1)
        assert_allclose(own[found.get_cells_type("triangle")], corners(surface, kept=kept), atol=FLOAT32)


def test_endings():
    assert [ending_of(name, SURFACES) for name in ("A.STL", "lh.pial.surf.gii", "a.gii", "a.vtu", "a")] == [
        ".stl", ".surf.gii", ".gii", "", ""]


def test_a_pipe_is_not_waited_for_and_a_folder_is_none(tmp_path):
    import os

    os.mkfifo(tmp_path / "a.stl")
    for path, code in ((tmp_path / "a.stl", "E106"), (tmp_path, "E106"), (tmp_path / "b.stl", "E100")):
        with pytest.raises(XfemnavError, match=code):
            read_surface(path)


def test_a_surface_is_read_without_a_librarys_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, content in SEEDS.items():
            decoded_surface(content, name.split("/")[-1])
