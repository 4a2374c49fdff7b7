"""GIfTI surfaces (.gii): the one POINTSET and TRIANGLE of a file; all else in it is kept.

FreeSurfer's surfaces count from the centre of their volume ("tkregister RAS"): `VolGeom...` in the metadata says where
that lies, as `mris_convert` and fMRIPrep write it (they put zeros there once they have added it), or a matrix to the
scanner's frame does. Spaces of a scanner, of Talairach or MNI are world RAS.
"""

import re
import zlib
from base64 import b64decode
from xml.etree import ElementTree
from xml.parsers.expat import ExpatError

import nibabel
import numpy as np
from nibabel.gifti import GiftiImage

from xfemnav.errors import XfemnavError
from xfemnav.imaging.points.surface_form import Form, damaged, unreadable
from xfemnav.imaging.reading.content import Zlib, read, silenced, size, unpacked_limit

POINTS, TRIANGLES = 1008, 1009  # NIfTI's codes of intent
UNKNOWN, SCANNER = 0, 1  # and of spaces
AGREE = 0.01  # mm, between two ways in which a file says where its centre lies
TAGS = 1_000_000
TKREGISTER = np.array([[-1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # columns: the axes of a volume to tkregister
FAULTS = (ElementTree.ParseError, ExpatError, AssertionError, ValueError, LookupError, TypeError, AttributeError,
          ArithmeticError, zlib.error, EOFError, MemoryError)


def decoded(content: bytes, name: str, limit: int) -> Form:
    """The surface in the bytes of a GIfTI file."""
    _check(content, name, limit)
    try:
        with silenced():
            image = GiftiImage.from_bytes(content)
        found = {code: [array for array in image.darrays if array.intent == code] for code in (POINTS, TRIANGLES)}
        if len(found[POINTS]) != 1 or len(found[TRIANGLES]) > 1:
            raise unreadable(name, f"holds {len(found[POINTS])} sets of points and {len(found[TRIANGLES])} of faces "
                                   "where one of each is a surface. Values alone (.shape.gii, .label.gii) stay as they "
                                   "are: points keep their order.")
        if any(np.shape(array.coordsys.xform) != (4, 4) for array in image.darrays if array.coordsys is not None):
            raise ValueError("a matrix of coordinates is not 4 x 4")
        pointset, triangles = found[POINTS][0], (found[TRIANGLES] or [None])[0]
        points = np.asarray(pointset.data, float).reshape(-1, 3)
        faces = np.zeros((0, 3), int) if triangles is None else np.asarray(triangles.data).reshape(-1, 3)
    except (nibabel.filebasedimages.ImageFileError, *FAULTS) as error:
        raise damaged(name, error) from None
    affine, words, doubt = _frame(image, pointset, name)

    def rewritten(new, kept) -> bytes:
        pointset.data = np.ascontiguousarray(new, pointset.data.dtype)
        if triangles is not None:
            triangles.data = np.ascontiguousarray(faces[kept], triangles.data.dtype)
        for array in (pointset, triangles) if triangles is not None else (pointset,):
            array.dims = list(array.data.shape)
        with silenced():
            return image.to_bytes(mode="force")

    return Form(points, faces.reshape(-1).astype(int), np.full(len(faces), 3), rewritten, affine=affine, words=words,
                doubt=doubt)


def _check(content: bytes, name: str, limit: int) -> None:
    """Refuse what nibabel would trust: data in other files, entities, more than `limit` bytes once unpacked."""
    if re.search(rb"<!\s*ENTITY", content) or content.count(b"<") > TAGS:
        raise unreadable(name, f"defines entities or has over {TAGS} tags; no surface does. Save it again.")
    try:
        left = most = unpacked_limit(len(content), limit)
        for array in ElementTree.fromstring(content).iter("DataArray"):
            encoding = array.get("Encoding", "")
            if "External" in encoding or array.get("ExternalFileName"):
                raise unreadable(name, "keeps its numbers in another file. Save it as one (GZipBase64Binary).")
            if "GZip" in encoding:
                text = "".join((array.findtext("Data") or "").split())
                left -= len(read(Zlib(b64decode(text)), left + 1, name))
                if left < 0:
                    raise XfemnavError("E102", f"{name} unpacks to more than {size(most)} from {size(len(content))}, "
                                               "which points do not. Check where it comes from.")
    except FAULTS as error:
        raise damaged(name, error) from None


def _frame(image, pointset, name: str) -> tuple[np.ndarray | None, str, str]:
    """The affine (4, 4) to world RAS mm and its description, or None and why nothing is known. Raises E701."""
    system = pointset.coordsys
    space, target, matrix = int(system.dataspace), int(system.xformspace), np.asarray(system.xform, float)
    if space != UNKNOWN:
        label = nibabel.nifti1.xform_codes.label[space] if space in nibabel.nifti1.xform_codes else str(space)
        return np.eye(4), f"RAS, {label} as the file says", ""
    stated = _volume({**image.meta, **pointset.meta}, name)
    if target == SCANNER and np.isfinite(matrix).all() and not np.allclose(matrix, np.eye(4)):
        if stated is not None and not np.allclose(stated, np.eye(4)) and abs(stated - matrix).max() > AGREE:
            raise unreadable(name, f"says twice where its centre lies: {_centre(matrix)} by its matrix to the scanner, "
                                   f"{_centre(stated)} by VolGeom. Convert it again (mris_convert --to-scanner).")
        return matrix, f"tkregister RAS, centre at {_centre(matrix)} as the file says", ""
    if stated is not None:
        return stated, f"tkregister RAS, centre at {_centre(stated)} as the file says", ""
    return None, "", ("its space is unknown, and it has no VolGeom, so its points are taken as world RAS; FreeSurfer's "
                      "are not (mris_convert --to-scanner)")


def _volume(meta, name: str) -> np.ndarray | None:
    """The affine (4, 4) from tkregister's frame to the scanner's by the metadata VolGeom, None where there is none."""
    if not all(f"VolGeomC_{axis}" in meta for axis in "RAS"):
        return None
    try:
        affine = np.eye(4)
        affine[:3, 3] = [float(meta[f"VolGeomC_{axis}"]) for axis in "RAS"]
        if all(f"VolGeom{column}_{axis}" in meta for column in "XYZ" for axis in "RAS"):
            axes = np.array([[float(meta[f"VolGeom{column}_{axis}"]) for column in "XYZ"] for axis in "RAS"])
            affine[:3, :3] = axes @ np.linalg.inv(TKREGISTER)
    except ValueError as error:
        raise damaged(name, f"VolGeom: {error}") from None
    turn = affine[:3, :3]
    if not np.isfinite(affine).all() or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3):
        raise unreadable(name, "has a VolGeom whose axes are no rotation. Convert it again: mris_convert --to-scanner.")
    return affine


def _centre(affine) -> str:
    return "({:.2f}, {:.2f}, {:.2f}) mm".format(*affine[:3, 3])
