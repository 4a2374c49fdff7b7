"""The known scene through every reader and writer: files made by other programs' libraries, and ours read by them.

Each check takes a folder to write in and raises `Mismatch`, or what the readers raise, where the scene comes back
otherwise. Frames are written out here by hand, so that a sign that is wrong in the program is not wrong here too.
"""

import gzip
import io
import json
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from xfemnav.imaging.carrying.landmarks import moved_points, resting_points
from xfemnav.imaging.carrying.streamlines import move_streamlines
from xfemnav.imaging.carrying.transform import backward, forward, roomy, write_transform
from xfemnav.imaging.carrying.vectors import field_nifti, write_nrrd
from xfemnav.imaging.carrying.warp import covered, pull_back, update
from xfemnav.imaging.frames.slices import take_slice, to_nifti
from xfemnav.imaging.points.point_files import read_points, write_points
from xfemnav.imaging.points.point_set import PointSet
from xfemnav.imaging.points.tract_files import read_streamlines, tract_bytes
from xfemnav.imaging.reading.gate import read_image
from xfemnav.imaging.reading.lean import nibabel
from xfemnav.imaging.selftest.known import HALF, OBLIQUE, ORDERS, STRAIGHT, Mismatch, agree
from xfemnav.imaging.selftest.roundtrip_directions import check_tensors, check_vectors
from xfemnav.imaging.selftest.roundtrip_surfaces import check_surfaces
from xfemnav.imaging.selftest.scenes import itk_image, scene_motion, scene_slice

EXACT, ROUNDED = 0.02, 0.6  # of values near 1000 as float32; of values rounded to whole numbers
MM = 1e-3  # float32 fields and affines of 100 mm
AROUND = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
STATED = PointSet("Fiducial", "p", [[12.0, -34.0, 56.0]], ("one",))


def check_nifti_nibabel(folder: Path) -> None:
    """Volumes written by nibabel as NIfTI, in all orders, are read with every value in its place."""
    _images(folder, "a.nii.gz", lambda path, *stored: nibabel.save(_nifti(*stored), path))


def check_nifti_itk(folder: Path) -> None:
    """The same by SimpleITK's writer of NIfTI."""
    _images(folder, "b.nii.gz", _write_itk)


def check_mgz(folder: Path) -> None:
    """The same of nibabel's MGH, compressed."""
    _images(folder, "c.mgz", lambda path, values, affine: nibabel.save(
        nibabel.MGHImage(values.astype(np.float32), affine), path))


def check_nrrd(folder: Path) -> None:
    """The same of SimpleITK's NRRD."""
    _images(folder, "d.nrrd", _write_itk)


def check_metaimage(folder: Path) -> None:
    """The same of SimpleITK's MetaImage."""
    _images(folder, "e.mha", _write_itk)


def check_dicom(folder: Path) -> None:
    """The same of a DICOM series, whose values are whole numbers."""
    # Slices of a series lie along its normal: the orders whose first two axes are in the slice, right-handed or not.
    _images(folder, "dicom", _write_dicom, ROUNDED, ("RAS", "LPS", "oblique"))


def check_nifti_frames(folder: Path) -> None:
    """An image whose sform and qform differ: either is read when it is asked for, and what is written has both."""
    values, sform = OBLIQUE.volume()
    _, qform = STRAIGHT.volume()
    image = nibabel.Nifti1Image(values.astype(np.float32), sform)
    image.set_qform(qform, 1)
    image.set_sform(sform, 2)
    nibabel.save(image, folder / "two.nii.gz")
    for wanted, affine in (("auto", sform), ("sform", sform), ("qform", qform)):
        found = read_image(folder / "two.nii.gz", nifti_frame=wanted)
        agree(f"the place of an image by its {wanted} frame", found.affine, affine, MM)
        frame = take_slice(found, plane="axial", index=1)
        nibabel.save(to_nifti(frame, frame.values), folder / "one.nii.gz")
        for name in ("two.nii.gz", "one.nii.gz"):
            first = (0, 0, 0 if name == "one.nii.gz" else 1)
            theirs = nibabel.load(folder / name).affine @ [*first, 1]
            agree(f"the slice of {name} in nibabel", theirs[:3], (sform @ [0, 0, 1, 1])[:3], MM)
            theirs = sitk.ReadImage(str(folder / name)).TransformIndexToPhysicalPoint(first)
            agree(f"the slice of {name} in SimpleITK", theirs, (qform @ [0, 0, 1, 1])[:3] * [-1, -1, 1], MM)


def _images(folder: Path, name: str, write, tolerance=EXACT, orders=tuple(ORDERS)) -> None:
    """The image of the scene in several storage orders: written, read, warped, and looked at where the file puts it."""
    for label in orders:
        scene, order, flips = ORDERS[label]
        path = folder / f"{label.replace(' ', '-')}-{name}"
        write(path, *scene.volume(order, flips))
        frame = take_slice(read_image(path), plane="axial", position_mm=scene.position_mm)
        motion = scene_motion(scene, frame)
        grid = frame.origin, frame.spacing, frame.values.shape
        made = update(frame.values, covered(motion.rest, *grid), pull_back(motion.rest, motion.moved, *grid))
        nibabel.save(to_nifti(frame, made.updated), folder / "updated.nii.gz")
        found = nibabel.load(folder / "updated.nii.gz")
        voxels = np.moveaxis(np.indices(found.shape), 0, -1)
        world = voxels @ found.affine[:3, :3].T + found.affine[:3, 3]
        agree(f"the image in {label} order", found.get_fdata(), scene.updated(world), tolerance)


def _nifti(values, affine) -> nibabel.Nifti1Image:
    image = nibabel.Nifti1Image(values.astype(np.float32), affine)
    image.set_sform(affine, 1)
    return image


def _write_itk(path, values, affine) -> None:
    sitk.WriteImage(itk_image(values, affine), str(path))


def _write_dicom(path, values, affine) -> None:
    """One DICOM file a slice, by GDCM."""
    path.mkdir()
    volume = sitk.Cast(itk_image(np.rint(values), affine), sitk.sitkInt16)
    writer, direction = sitk.ImageFileWriter(), volume.GetDirection()
    writer.KeepOriginalImageUIDOn()
    for k in range(volume.GetSize()[2]):
        plane = volume[:, :, k]
        for tag, value in {
            "0008|0008": "DERIVED\\SECONDARY", "0008|0060": "MR", "0020|000e": "1.2.826.0.1.3680043.2.1125.1",
            "0008|0018": f"1.2.826.0.1.3680043.2.1125.1.{k + 1}", "0020|0013": str(k + 1),
            "0020|0032": "\\".join(f"{x:.6f}" for x in volume.TransformIndexToPhysicalPoint((0, 0, k))),
            "0020|0037": "\\".join(f"{direction[3 * i + j]:.9f}" for j in (0, 1) for i in range(3)),
            "0018|0050": f"{volume.GetSpacing()[2]:g}",
        }.items():
            plane.SetMetaData(tag, value)
        writer.SetFileName(str(path / f"{k}.dcm"))
        writer.Execute(plane)


def check_transform(folder: Path) -> None:
    """ITK's transform takes places of now to where their tissue rested, and the other one back."""
    frame, motion, inner = _slice_and_motion()
    write_transform(folder / "t.h5", frame, backward(frame, motion.rest, motion))
    _maps("t.h5", sitk.ReadTransform(str(folder / "t.h5")), OBLIQUE.now(inner), inner)
    write_transform(folder / "f.h5", frame, forward(frame, motion))
    _maps("forward .h5", sitk.ReadTransform(str(folder / "f.h5")), inner, OBLIQUE.now(inner))


def check_field_nrrd(folder: Path) -> None:
    """Displacement fields in NRRD, by ITK's interpolation, take places where the motion does, both ways."""
    frame, motion, inner = _slice_and_motion()
    write_nrrd(folder / "f.nrrd", frame, backward(frame, motion.rest, motion), "resampling")
    _maps("resampling .nrrd", _read_field(folder / "f.nrrd"), OBLIQUE.now(inner), inner)
    write_nrrd(folder / "m.nrrd", frame, forward(frame, motion), "modeling")
    _maps("modeling .nrrd", _read_field(folder / "m.nrrd"), inner, OBLIQUE.now(inner))


def check_field_nifti(folder: Path) -> None:
    """The field of a run in NIfTI takes places of now to where their tissue rested."""
    frame, motion, inner = _slice_and_motion()
    nibabel.save(field_nifti(frame, backward(frame, motion.rest, motion)), folder / "f.nii.gz")
    _maps("field .nii.gz", _read_field(folder / "f.nii.gz"), OBLIQUE.now(inner), inner)


def _slice_and_motion():
    """A slice with room for the scene's motion, that, and places at rest well within the halves."""
    frame = scene_slice(OBLIQUE)
    motion = scene_motion(OBLIQUE, frame)
    return roomy(frame, np.concatenate([motion.rest, motion.moved])), motion, OBLIQUE.inner()


def _read_field(path) -> sitk.Transform:
    return sitk.DisplacementFieldTransform(sitk.ReadImage(str(path), sitk.sitkVectorFloat64))


def _maps(what: str, transform: sitk.Transform, places, wanted) -> None:
    """Whether a transform takes plane `places` of the oblique scene to the `wanted` ones, both (n, 2)."""
    flip = np.array([-1.0, -1.0, 1.0])  # ITK counts in LPS
    found = [transform.TransformPoint((world * flip).tolist()) for world in OBLIQUE.world(places)]
    agree(what, np.array(found) * flip, OBLIQUE.world(wanted), MM)


READ = {
    "lps.mrk.json": '{"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": '
                    '[{"label": "one", "position": [-12, 34, 56]}]}]}',
    "ras.mrk.json": '{"markups": [{"type": "Fiducial", "coordinateSystem": "RAS", "controlPoints": '
                    '[{"label": "one", "position": [12, -34, 56]}]}]}',
    "lps.fcsv": "# CoordinateSystem = LPS\n# columns = id,x,y,z,label\n1,-12,34,56,one\n",
    "old.fcsv": "# CoordinateSystem = 0\n# columns = id,x,y,z,label\n1,12,-34,56,one\n",
    "lps.csv": "x,y,z,label\n-12,34,56,one\n",
    "ras.csv": "r,a,s,label\n12,-34,56,one\n",
    "slicer.csv": "label,r,a,s,defined,selected,visible,locked,description\none,12,-34,56,1,1,1,0,\n"
                  "two,0,0,0,0,1,1,0,\n",
    "slicer.tsv": "label\tl\tp\ts\tdefined\tselected\none\t-12\t34\t56\t1\t1\n",
    "sub-1_electrodes.tsv": "name\tx\ty\tz\none\t1.2\t-3.4\t5.6\ntwo\tn/a\tn/a\tn/a\n",
    "ras.tag": 'MNI Tag Point File\nVolumes = 1;\nPoints =\n 12 -34 56 "one";\n',
}
#: Name of a file that is written: how its first point is found in its text, and its signs against RAS.
WRITTEN = {
    "w.mrk.json": (lambda text: json.loads(text)["markups"][0]["controlPoints"][0]["position"], (-1, -1, 1)),
    "w.fcsv": (lambda text: text.strip().splitlines()[-1].split(",")[1:4], (-1, -1, 1)),
    "w.csv": (lambda text: text.strip().splitlines()[-1].split(",")[:3], (-1, -1, 1)),
    "w.tag": (lambda text: text.partition("Points =")[2].split()[:3], (1, 1, 1)),
}


SYSTEM = '{"iEEGCoordinateSystem": "ScanRAS", "iEEGCoordinateUnits": "cm"}'


def check_points(folder: Path) -> None:
    """One point in every format of points, read where it is, and written with the signs that the format counts in."""
    (folder / "sub-1_coordsystem.json").write_text(SYSTEM)
    for name, text in READ.items():
        (folder / name).write_text(text)
        found = read_points(folder / name)
        agree(f"the point in {name}", found.points, STATED.points, 1e-9)
        write_points(folder / name, found)
        agree(f"the point in {name}, written anew", read_points(folder / name).points, STATED.points, 1e-9)
    for name, (first, signs) in WRITTEN.items():
        write_points(folder / name, STATED)
        agree(f"the point written to {name}", [float(x) for x in first((folder / name).read_text())],
              STATED.points[0] * signs, 1e-9)


def check_landmarks(folder: Path) -> None:
    """Landmarks off the slice move with it and back; one on the cut has a place on each lip."""
    frame, motion, inner = _slice_and_motion()
    there, off = OBLIQUE.world(inner), 2.0 * OBLIQUE.turn[:, 2]
    found = moved_points(there + off, frame, motion, motion.rest)
    agree("the moved landmarks", found.moved, OBLIQUE.world(OBLIQUE.now(inner)) + off, 1e-9)
    back = resting_points(found.moved, frame, motion, frame.from_world(OBLIQUE.world(2 * HALF * AROUND))[0])
    agree("the landmarks brought back", back.moved, there + off, 1e-9)
    lips = moved_points(OBLIQUE.world([[0.0, 3.0]]), frame, motion, motion.rest).lips[0]
    wanted = OBLIQUE.world(np.concatenate([OBLIQUE.now([[side * 1e-12, 3.0]]) for side in (-1, 1)]))
    agree("the left and right lip of a landmark on the cut", lips, wanted, 1e-6)


def check_streamlines(folder: Path) -> None:
    """Streamlines of TRK and TCK move as their tissue, and are written for nibabel to read the same."""
    ends = np.array([[-12.0, -9.0], [-4.0, 8.0]])
    affine = np.array([[2.0, 0, 0, -90], [0, 2, 0, -126], [0, 0, 2, -72], [0, 0, 0, 1]])
    header = {"voxel_to_rasmm": affine, "dimensions": (91, 109, 91), "voxel_sizes": (2.0, 2.0, 2.0),
              "voxel_order": "RAS"}
    tracts = nibabel.streamlines.Tractogram([STRAIGHT.world(ends)], affine_to_rasmm=np.eye(4))
    frame = scene_slice(STRAIGHT)
    motion = scene_motion(STRAIGHT, frame)
    for suffix in ("trk", "trk.gz", "tck"):
        kind = nibabel.streamlines.TckFile if suffix == "tck" else nibabel.streamlines.TrkFile
        kind(tracts, header=None if suffix == "tck" else header).save(written := io.BytesIO())
        content = written.getvalue()
        (folder / f"in.{suffix}").write_bytes(gzip.compress(content) if suffix.endswith("gz") else content)
        found = move_streamlines(read_streamlines(folder / f"in.{suffix}"), frame, motion, motion.rest)
        (folder / f"out.{suffix}").write_bytes(tract_bytes(found.file, suffix))
        line = nibabel.streamlines.load(folder / f"out.{suffix}").streamlines
        if len(line) != 1:
            raise Mismatch(f"one streamline of .{suffix} became {len(line)}")
        agree(f"a streamline of .{suffix}", line[0][[0, -1]], STRAIGHT.world(STRAIGHT.now(ends)), MM)


#: What is checked, by whom, and the library that a fault points to.
CHECKS = (
    ("NIfTI images by nibabel", check_nifti_nibabel, "nibabel"),
    ("NIfTI images by SimpleITK", check_nifti_itk, "SimpleITK"),
    ("NIfTI frames, both, in nibabel and SimpleITK", check_nifti_frames, "nibabel"),
    ("MGZ images by nibabel", check_mgz, "nibabel"),
    ("NRRD images by SimpleITK", check_nrrd, "SimpleITK"),
    ("MetaImage images by SimpleITK", check_metaimage, "SimpleITK"),
    ("DICOM series by SimpleITK", check_dicom, "SimpleITK"),
    ("transforms .h5 in SimpleITK, both directions", check_transform, "SimpleITK"),
    ("fields .nrrd in SimpleITK, both directions", check_field_nrrd, "SimpleITK"),
    ("fields .nii.gz in SimpleITK", check_field_nifti, "SimpleITK"),
    ("vectors of NIfTI, NRRD, MetaImage; FSL, ANTs, MRtrix, ITK", check_vectors, "nibabel"),
    ("tensors of NIfTI, NRRD; FSL, ANTs, MRtrix, ITK", check_tensors, "nibabel"),
    ("point files .mrk.json, .fcsv, .csv, .tsv, .tag", check_points, "xfemnav"),
    ("landmarks there and back", check_landmarks, "xfemnav"),
    ("streamlines .trk, .trk.gz, .tck", check_streamlines, "nibabel"),
    ("surfaces .stl, .vtk, .vtp, .gii, .obj, .ply", check_surfaces, "meshio"),
)
