"""The image ends inside the organ: W212 says so, the outline is held there, and no cut opens it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import xfemnav
from tests.images import slice_of
from tests.meshes import BRAIN, cut_in, disc, posed, space_of
from tests.small import RAS, brain, write
from xfemnav.errors import XfemnavError, XfemnavWarning
from xfemnav.imaging.frames.slices import touching
from xfemnav.imaging.organ.segment import segment
from xfemnav.mechanics.conditions.skull import skull_conditions
from xfemnav.mechanics.rules import Skull
from xfemnav.pipeline.running.session import Session

COARSE = {"element_size_mm": 6.0, "corridor_element_mm": 3.0}
ROWS = 35  # where the brain of 72 rows is cut off: its centre lies in row 35.5
END = RAS[1, 3] + 2.0 * (ROWS - 0.5)  # mm: the lower edge of the first row that is left


@pytest.fixture(scope="module")
def cropped(tmp_path_factory):
    """The front half of the brain: its image ends 1 to 2 mm from the centre, along 88 mm."""
    affine = RAS.copy()
    affine[1, 3] += 2.0 * ROWS
    return write(tmp_path_factory.mktemp("border") / "half.nii.gz", brain()[:, ROWS:], affine)


def test_the_length_of_the_stretch_is_told():
    values = np.zeros((40, 50))
    values[:30, 10:35] = 5.0 + np.arange(25)
    with pytest.warns(XfemnavWarning, match="W212 .*along 50 mm"):
        segment(slice_of(values, (1.0, 2.0)))
    mask = values > 0
    assert touching(mask, (1.0, 2.0)) == 50 and touching(mask[1:], (1.0, 2.0)) == 50
    assert touching(np.pad(mask, 1), (1.0, 2.0)) == 0
    assert slice_of(np.pad(values, 1)).border(np.pad(mask, 1)) is None


def test_the_rectangle_is_that_of_the_pixels():
    slice = slice_of(np.ones((4, 6)), (1.0, 2.0), (10.0, 20.0))
    low, high, near = slice.border(np.ones((4, 6), bool))
    assert_allclose([low, high], [[9.5, 19], [13.5, 31]])
    assert near == 1.5, "less than the pixel by which an organ that ends before the border stays away"


@pytest.mark.parametrize("kind", ["fixed", "sliding", "free", "contact"])
def test_the_outline_is_held_there_whatever_the_skull_and_near_any_mouth(kind):
    mesh = disc()
    radius = np.hypot(*mesh.points.T).max()
    cut = cut_in(mesh, (3, 80), (1.7, 12.3))
    space = space_of(mesh, cut)
    mouth = space.parts.paths[0][:1]
    skull = Skull(kind, craniotomy_mm=2.5 * radius, border=((-99.0, -99.0), (99.0, 99.0), 0.5))
    open_everywhere = skull_conditions(space, skull, mouth, BRAIN)
    assert not open_everywhere.constraints.C.nnz and not open_everywhere.springs.nnz
    at = mouth[0, 1] - 3.0  # the border runs 3 mm below the mouth's height, and all above it is outside
    found = skull_conditions(space, replace(skull, border=((-99.0, -99.0), (99.0, at), 6.0)), mouth, BRAIN)
    held = np.unique(space.enrichment.node[found.constraints.C.indices // 2])
    ends = mesh.boundary_facets[abs(mesh.points[mesh.boundary_facets].mean(axis=1)[:, 1] - at) < 6.0]
    assert len(ends) > 3 and set(held) >= set(np.unique(ends))
    assert not found.constraints.d.any()


def test_a_run_holds_the_border_beside_a_mouth(cropped, tmp_path):
    """The mouth is 11 mm from the border: the craniotomy of 20 mm would have freed it."""
    with pytest.warns(XfemnavWarning, match="W212"):
        result = xfemnav.run(cropped, cut="-60,12 -15,8", opening_mm=3, blade="0,0.6", output=tmp_path / "out",
                             cache=tmp_path / "cache", report=False, **COARSE)
    assert [w["code"] for w in result.record["warnings"]] == ["W212"]
    assert "along 88 mm" in result.record["warnings"][0]["text"]
    along = np.column_stack([np.linspace(-36, 36, 33), np.full(33, END + 0.2)])
    assert np.linalg.norm(result.displacement(along), axis=1).max() < 0.1
    assert np.linalg.norm(result.displacement([[-40.0, 16.0]])) > 0.5, "and elsewhere it is open"


@pytest.mark.filterwarnings("ignore::xfemnav.errors.XfemnavWarning")
def test_a_cut_through_the_border_is_refused(cropped, tmp_path):
    across = [[-10.0, -20.0], [-5.0, 25.0]]
    session = Session(cropped, corridor="-10,-20 -5,25", **COARSE)
    for cut in (lambda: xfemnav.run(cropped, cut="-10,-20 -5,25", opening_mm=4, output=tmp_path / "out",
                                    cache=tmp_path / "cache", report=False, **COARSE), lambda: session.cut(across)):
        with pytest.raises(XfemnavError) as failure:
            cut()
        assert failure.value.code == "E302" and "the image ends inside the organ" in failure.value.message


def test_only_what_lies_on_the_border_is_refused():
    mesh = disc()
    cut = cut_in(mesh, (3, 80), (1.7, 12.3))
    y = cut.path[0, 1]
    posed(mesh, (cut,), BRAIN, Skull(border=((-99.0, -99.0), (99.0, y - 2.0), 1.0)))
    with pytest.raises(XfemnavError, match="E302"):
        posed(mesh, (cut,), BRAIN, Skull(border=((-99.0, -99.0), (99.0, y + 0.2), 1.0)))
