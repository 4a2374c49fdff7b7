"""The figure: what is drawn where, the patient's sides, the lips' names, and bytes that depend on the data alone."""

import subprocess
import sys
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial import Delaunay

from xfemnav.geometry.mesh import Mesh
from xfemnav.pipeline.telling import display, figure

RADIUS, MOUTH, TIP = 60.0, np.array([0.0, 60.0]), np.array([0.0, 20.0])


def cut(*path, name="cut"):
    return SimpleNamespace(path=np.array(path, float), name=name)


def enriched(heaviside_nodes, tip_nodes):
    return SimpleNamespace(heaviside_nodes=np.array(heaviside_nodes, int), tip_nodes=np.array(tip_nodes, int))


def opened(points):
    """A smooth stand-in for a retraction, (n, 2) -> (n, 2) mm: the lips of the cut x = 0, y > 20 part by up to 6 mm."""
    x, y = points.T
    opening = 3 * np.sqrt(np.clip((y - TIP[1]) / 40, 0, None)) * np.exp(-np.abs(x) / 15)
    return np.stack([np.where(x > 0, opening, -opening), 0 * y], axis=1)


@pytest.fixture(scope="module")
def run():
    """Slice, mask, problem, solution and update of a disc with a straight cut from its top, made without the solver."""
    first, second = np.meshgrid(np.arange(-78, 79, 2.0), np.arange(-70, 71, 2.5), indexing="ij")
    radius = np.hypot(first, second)
    mask = radius < RADIUS
    values = np.where(mask, 500 + 200 * np.cos(first / 6) * np.cos(second / 9), 900.0 * (radius < 68))
    plane = SimpleNamespace(values=values, origin=np.array([-78.0, -70.0]), spacing=np.array([2.0, 2.5]),
                            axes=np.eye(3), offset=18.0, plane="axial")
    ring = RADIUS * np.stack([np.cos(t := np.linspace(0, 2 * np.pi, 73)[:-1]), np.sin(t)], axis=1)
    grid = np.stack(np.meshgrid(np.arange(-56.5, 57, 4.5), np.arange(-56.5, 57, 4.5)), axis=-1).reshape(-1, 2)
    points = np.concatenate([ring, grid[np.linalg.norm(grid, axis=1) < RADIUS - 3]])
    mesh = Mesh(points, (cells := Delaunay(points).simplices)[:, ::1])
    near, height = np.abs(points[:, 0]) < 5, points[:, 1]
    enrichment = enriched(np.flatnonzero(near & (height > 25)), np.flatnonzero(near & (np.abs(height - 20) < 5)))
    problem = SimpleNamespace(mesh=mesh, cuts=(cut(MOUTH, TIP),), enrichment=enrichment, resections=(),
                              parts=SimpleNamespace(fronts=SimpleNamespace(at=np.array([TIP]))))
    rest = points[cells]
    inward = rest + 1e-6 * (rest.mean(axis=1, keepdims=True) - rest)
    solution = SimpleNamespace(rest=rest, moved=rest + opened(inward.reshape(-1, 2)).reshape(rest.shape))
    cavity = mask & (np.abs(first) < 3) & (second > 25)
    nowhere = np.zeros_like(mask)
    update = SimpleNamespace(updated=np.where(cavity, 900, values), cavity=cavity, vacated=nowhere, overlap=nowhere,
                             field=np.zeros((*mask.shape, 2)))
    return plane, mask, problem, solution, update


def test_same_data_same_bytes(run, tmp_path):
    first = figure.draw_figure(tmp_path / "a.png", *run).read_bytes()
    with matplotlib.rc_context({"font.size": 30, "image.origin": "upper", "axes.facecolor": "red"}):
        second = figure.draw_figure(tmp_path / "b.png", *run).read_bytes()
    assert first == second, "the user's own matplotlib settings changed the figure"
    assert first.startswith(b"\x89PNG")
    assert b"Software" not in first and b"tIME" not in first


def test_a_pixel_is_drawn_at_its_place_in_the_plane(run):
    plane = run[0]
    values = np.zeros(plane.values.shape)
    values[50, 10] = 1.0
    panel = Figure().subplots()
    figure.draw_grey(panel, plane, values, (0, 1))
    image = panel.images[0]
    row, column = np.argwhere(np.asarray(image.get_array()) == 1)[0]
    west, east, south, north = image.get_extent()
    shown = [west + (column + 0.5) / values.shape[0] * (east - west),
             south + (row + 0.5) / values.shape[1] * (north - south)]
    np.testing.assert_allclose(shown, plane.origin + plane.spacing * [50, 10], rtol=0, atol=1e-9)
    assert image.origin == "lower" and panel.get_ylim()[0] < panel.get_ylim()[1], "e2 points upwards"


WORLD = {"axial": (0, 1, 2), "coronal": (0, 2, 1), "sagittal": (1, 2, 0)}  # axes R A S of e1, e2, normal


def axes_of(plane):
    return np.eye(3)[list(WORLD[plane])]


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("travel, left, letters", [((0, -1), (1, 0), "RL"), ((0, 1), (-1, 0), "LR"),
                                                   ((1, 0), (0, 1), "AP"), ((-1, 0), (0, -1), "PA")])
def test_lips_are_named_by_the_patients_sides_that_they_lie_towards(travel, left, letters, inverted):
    """'left' when walking from the mouth to the tip is `left`; each name stands on its own side on the screen too."""
    panel = Figure().subplots()
    figure.look_at(panel, np.array([[-1.0, -1.0], [1.0, 1.0]]), inverted)
    figure._name_lips(panel, np.array([(0, 0), travel], float), np.eye(3), 10, "black", "white")
    offsets = {text.get_text(): np.array(text.xyann) for text in panel.texts}
    shown = np.array(left) * ([-1, 1] if inverted else 1)
    np.testing.assert_allclose(offsets[f"{letters[0]} lip"], 10 * shown, atol=1e-12)
    np.testing.assert_allclose(offsets[f"{letters[1]} lip"], -10 * shown, atol=1e-12)


@pytest.mark.parametrize("axis, ends", [((1, 0, 0), "LR"), ((0, 1, 0), "PA"), ((0, 0, 1), "IS"), ((-1, 0, 0), "RL"),
                                        ((0, 0.9, 0.43), "PA")])
def test_letters_of_the_patients_sides(axis, ends):
    assert display.ends(np.array(axis)) == ends


@pytest.mark.parametrize("plane, way, letters, words", [
    ("axial", "neurological", "LRPA", "neurological display: the patient's left on the left, anterior at the top"),
    ("axial", "radiological", "RLPA", "radiological display: the patient's right on the left, anterior at the top"),
    ("coronal", "neurological", "LRIS", "neurological display: the patient's left on the left, superior at the top"),
    ("coronal", "radiological", "RLIS", "radiological display: the patient's right on the left, superior at the top"),
    ("sagittal", "neurological", "PAIS", "anterior on the right, superior at the top"),
    ("sagittal", "radiological", "PAIS", "anterior on the right, superior at the top")])
def test_letters_and_caption_say_how_the_slice_is_shown(plane, way, letters, words):
    assert "".join(display.edges(plane, axes_of(plane), way)) == letters
    shown = SimpleNamespace(plane=plane, offset=1.0, axes=axes_of(plane))
    caption = figure._caption(shown, [cut((0, 9), (0, 0), name="a"), cut((9, 0), (0, 0), name="b")], way)
    assert caption[0].startswith(f"{plane} slice at 1.0 mm, {words}.")
    east, south = "A" if plane == "sagittal" else "R", "P" if plane == "axial" else "I"
    where = " in neurological display" if letters[0] == "R" else ""
    assert caption[1] == (f"Left and right of a cut are seen from its mouth{where}: left of 'a' is the {east} lip; "
                          f"left of 'b' is the {south} lip.")
    assert len(figure._caption(shown, [], way)) == 1


@pytest.mark.parametrize("way", ["neurological", "radiological"])
@pytest.mark.parametrize("plane", ["axial", "coronal", "sagittal"])
def test_a_mark_is_drawn_on_the_side_of_its_letter(run, plane, way):
    """A bright mark on the patient's right (in sagittal slices: in front) lies on that letter's side in the pixels of
    (a) and (d)."""
    slice_, mask, problem, solution, update = run
    mark = np.where(mask, 100.0, 0.0)
    mark[-30:-20, 25:32] = np.where(mask, 1e6, 0.0)[-30:-20, 25:32]
    marked = SimpleNamespace(**{**vars(slice_), "values": mark, "plane": plane, "axes": axes_of(plane)})
    drawn = SimpleNamespace(**{**vars(update), "updated": mark})
    canvas = FigureCanvasAgg(found := figure._drawn(marked, mask, problem, solution, drawn, way))
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3].min(axis=2)
    for panel in (found.axes[0], found.axes[3]):
        x, y = panel.transAxes.transform([[0.1, 0.2], [0.9, 0.8]]).round().astype(int).T
        inside = pixels[len(pixels) - y[1]:len(pixels) - y[0], x[0]:x[1]]  # without letters and scale bar
        column = np.argwhere(inside > 250)[:, 1].mean() / inside.shape[1]
        letter = next(text for text in panel.texts if text.get_text() == ("A" if plane == "sagittal" else "R"))
        assert (column > 0.5) == (letter.get_position()[0] > 0.5), (column, letter.get_position())
        assert (column > 0.5) == (plane == "sagittal" or way == "neurological")


def test_close_view_holds_every_cut_in_the_shape_of_the_whole():
    whole = np.array([[-70.0, -90.0], [70.0, 90.0]])
    cuts = [cut((0, 80), (5, 40)), cut((30, 60), (20, 50))]
    close = figure._box_of_cuts([each.path for each in cuts], whole)
    points = np.concatenate([each.path for each in cuts])
    assert (points >= close[0]).all() and (points <= close[1]).all()
    np.testing.assert_allclose((close[1] - close[0])[1] / (close[1] - close[0])[0], 180 / 140)
    assert figure._box_of_cuts([], whole) is whole


def test_inset_keeps_away_from_every_cut():
    def lines(*cuts):
        return SimpleNamespace(cuts=cuts, resections=())

    box = np.array([[0.0, 0.0], [100.0, 100.0]])
    upper_left, lower_right = cut((10, 90), (30, 70)), cut((70, 20), (90, 30))
    panel = Figure().subplots()
    x, y = figure._emptiest_corner(panel, box, lines(upper_left, cut((60, 90), (90, 60)), lower_right))
    assert x < 0.5 and y < 0.5
    x, y = figure._emptiest_corner(panel, box, lines(upper_left, cut((10, 30), (30, 10)), lower_right))
    assert x > 0.5 and y > 0.5
    figure.look_at(panel, box, True)
    x, y = figure._emptiest_corner(panel, box, lines(upper_left, cut((10, 30), (30, 10)), lower_right))
    assert x < 0.5 and y > 0.5


def test_grey_window_holds_the_organ_and_a_background_that_is_near(run):
    plane, mask = run[:2]

    def window(values):
        return figure.window(SimpleNamespace(values=values), mask)

    low, high = np.percentile(plane.values[mask], [0.5, 99.5])
    np.testing.assert_allclose(window(plane.values), (0, high))
    np.testing.assert_allclose(window((plane.values - 500) / 200), (-2.5, (high - 500) / 200))
    np.testing.assert_allclose(window(-plane.values), (-high, 0))
    air = np.where(mask, plane.values, -5000.0)    # too far from the organ to share a window with it
    np.testing.assert_allclose(window(air), (low, high))


def test_only_tissue_is_shown_in_the_updated_slice(run):
    """Not the scalp; the cavity as the file has it, and tissue that has moved out of the mask."""
    plane, mask, _, _, update = run
    out = tuple(np.argwhere(~mask & (plane.values > 0))[0])
    field = update.field.copy()
    field[out] = 1.0
    panel = Figure().subplots()
    figure._updated(panel, plane, mask, SimpleNamespace(**{**vars(update), "field": field}), (0, 1000))
    values = panel.images[0].get_array().T
    shown = ~np.ma.getmaskarray(values)
    assert shown[out] and shown.sum() == mask.sum() + 1
    assert (values[update.cavity] == 900).all()


def test_overlap_is_drawn_and_a_run_without_cut_too(run, tmp_path):
    plane, mask, problem, solution, update = run
    twice = SimpleNamespace(**{**vars(update), "overlap": update.cavity})
    none = SimpleNamespace(mesh=problem.mesh, cuts=(), enrichment=enriched([], []), resections=(),
                           parts=SimpleNamespace(fronts=SimpleNamespace(at=np.empty((0, 2)))))
    plain = figure.draw_figure(tmp_path / "a.png", plane, mask, problem, solution, update).read_bytes()
    assert figure.draw_figure(tmp_path / "b.png", plane, mask, problem, solution, twice).read_bytes() != plain
    assert figure.draw_figure(tmp_path / "c.png", plane, mask, none, solution, update).stat().st_size > 10_000


def test_pyplot_is_never_imported():
    """pyplot looks for a display and keeps global state; a figure of its own needs neither."""
    code = "import sys, xfemnav.pipeline.telling.figure; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
