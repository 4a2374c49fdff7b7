"""The known scene as this program has it: its slice, triangles and motion."""

from xfemnav.geometry.affine_map import PiecewiseAffineMap
from xfemnav.imaging.known import CUT, Scene
from xfemnav.imaging.reading import Image
from xfemnav.imaging.slices import Slice, take_slice


def scene_triangles(scene: Scene, frame: Slice):
    """The triangles of the scene at rest and now in plane coordinates of a slice, both (4, 3, 2) mm."""
    return (frame.from_world(scene.world(corners))[0] for corners in (scene.rest, scene.moved))


def scene_slice(scene: Scene) -> Slice:
    """The scene's slice, without a file."""
    values, affine = scene.volume()
    return take_slice(Image(values, affine, "float64", 2, "", "scene"), plane="axial", position_mm=scene.position_mm)


def scene_motion(scene: Scene, frame: Slice, rest, moved) -> PiecewiseAffineMap:
    """The motion of the triangles, two-valued on the scene's cut."""
    return PiecewiseAffineMap(rest, moved, (frame.from_world(scene.world(CUT))[0],))
