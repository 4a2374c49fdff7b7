"""Sound files of every format that is read, each with how it is read and which of its bytes a checksum covers."""

import gzip
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import nibabel
import numpy as np
import SimpleITK as sitk
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLosslessSV1,
    RLELossless,
)

from tests.fuzz.seeds import AFFINE, CUT, KINDS, SEEDS, finished
from tests.fuzz.surface_seeds import SEEDS as SURFACES
from tests.images import affine_of, image_of
from tests.test_dicom import write_series
from tests.test_dicom_kinds import compressed
from xfemnav.imaging.points.point_files import read_points
from xfemnav.imaging.points.surface_files import read_surface
from xfemnav.imaging.points.tract_files import read_streamlines
from xfemnav.imaging.reading.gate import read_components, read_image
from xfemnav.pipeline.asking.config import configure, read_displacements
from xfemnav.pipeline.keeping import kernels
from xfemnav.pipeline.keeping.cache import Cache
from xfemnav.pipeline.keeping.files import nifti_bytes, read_vtu
from xfemnav.pipeline.running.apply import apply
from xfemnav.pipeline.running.result import Result

PACKED = re.compile(rb"[A-Za-z0-9+/=]{24,}")  # an array in base64


class Anew(Exception):
    """What was damaged was noticed, and made anew as it was."""


def none(content: bytes) -> list[range]:
    return []


def whole(content: bytes) -> list[range]:
    return [range(len(content))]


class Format(NamedTuple):
    """How a format is tried: `make(folder)` writes its files and gives the path that is read; `read(path)` gives what
    it means, as bytes, or raises XfemnavError or Anew. `covered(content)` are the places in a file's content, ranges,
    that a checksum covers: a change there is noticed, or means nothing.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], bytes]
    covered: Callable[[bytes], list[range]] = none


def behind(mark: bytes) -> Callable[[bytes], list[range]]:
    """What follows a header; all of a file that has none."""
    return lambda content: [range(content.find(mark) + len(mark) if mark in content else 0, len(content))]


def arrays(content: bytes) -> list[range]:
    """Compressed arrays in base64."""
    return [range(*found.span()) for found in PACKED.finditer(content)]


# Images ---------------------------------------------------------------------------------------------------------------

VOXELS = np.random.default_rng(8).integers(-300, 4000, (12, 10, 6)).astype(np.int16)
SLICES = image_of(VOXELS, affine_of(np.diag([1.0, 1.5, 3.0])))


def image(path: Path) -> bytes:
    found = read_image(path)
    return found.values.tobytes() + found.affine.tobytes()


def by_nibabel(name: str, kind=nibabel.Nifti1Image) -> Callable[[Path], Path]:
    def make(folder):
        made = kind(VOXELS, AFFINE.astype(np.float32))
        if kind is nibabel.Nifti1Image:
            made.set_qform(AFFINE, code=1)
        (folder / name).write_bytes(made.to_bytes() if not name.endswith("gz") else nifti_bytes(made))
        return folder / name
    return make


def by_itk(name: str, pack: bool) -> Callable[[Path], Path]:
    def make(folder):
        made = sitk.GetImageFromArray(VOXELS.T)
        made.SetSpacing((0.9, 1.1, 2.0))
        made.SetOrigin((-10.0, 20.0, 5.5))
        sitk.WriteImage(made, folder / name, useCompression=pack)
        return folder / name
    return make


def series(syntax) -> Callable[[Path], Path]:
    """Six slices; of JPEG two, whose decoders are slow."""
    volume = SLICES if syntax in (ExplicitVRLittleEndian, DeflatedExplicitVRLittleEndian, RLELossless) else replace(
        SLICES, values=SLICES.values[:, :, :2])

    def make(folder):
        inflated = ExplicitVRLittleEndian if syntax != DeflatedExplicitVRLittleEndian else syntax
        write_series(volume, folder / "series", inflated, BitsStored=16)
        for path in sorted((folder / "series").iterdir()):
            compressed(path, syntax)
        (folder / "packed.dcm").unlink(missing_ok=True)
        return folder / "series"
    return make


# Points, streamlines, surfaces, meshes, fields ------------------------------------------------------------------------

def of_bytes(name: str, content: Callable[[], bytes]) -> Callable[[Path], Path]:
    def make(folder):
        (folder / name).write_bytes(content())
        return folder / name
    return make


def seed(target: str, number: int) -> Callable[[Path], Path]:
    """A seed of the fuzzer, whose first byte names it."""
    first = SEEDS[target]()[number]
    return of_bytes(KINDS[target][first[0]], lambda: first[1:])


def points(path: Path) -> bytes:
    found = read_points(path)
    return found.points.tobytes() + repr(found.labels).encode()


def tracts(path: Path) -> bytes:
    found = read_streamlines(path).streamlines
    return b"".join(np.asarray(line).tobytes() for line in found) + repr([len(line) for line in found]).encode()


def tractogram(name: str) -> Callable[[Path], Path]:
    def make(folder):
        rng = np.random.default_rng(3)
        lines = [rng.uniform(-40, 40, (n, 3)).astype(np.float32) for n in (12, 2, 30, 7)]
        nibabel.streamlines.save(nibabel.streamlines.Tractogram(lines, affine_to_rasmm=np.eye(4)),
                                 str(folder / name.removesuffix(".gz")))
        if name.endswith(".gz"):
            plain = folder / name.removesuffix(".gz")
            (folder / name).write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
            plain.unlink()
        return folder / name
    return make


def surface(path: Path) -> bytes:
    found = read_surface(path)
    return found.points.tobytes() + found.corners.tobytes() + found.count.tobytes()


def mesh(path: Path) -> bytes:
    found = read_vtu(path, "E701", ("displacement",))
    return found.points.tobytes() + found.cells.tobytes() + b"".join(
        values.tobytes() for values in found.point_data.values())


def field(path: Path) -> bytes:
    found = read_components(path)
    return found.values.tobytes() + found.affine.tobytes()


def of_run(pattern: str) -> Callable[[Path], Path]:
    """A file that a run has left."""
    def make(folder):
        source, = (Path(finished().name) / "out").glob(pattern)
        return Path(shutil.copy(source, folder))
    return make


# Records, scenarios, caches, kernels ----------------------------------------------------------------------------------

def record(folder: Path) -> Path:
    """The files of a run, landmarks that it is applied to, and its record alone to be changed."""
    shutil.copytree(Path(finished().name) / "out", folder.parent / "out", dirs_exist_ok=True)
    (folder.parent / "points.csv").write_text("x,y,z,label\n30,-8,10,a\n15,-5,10,b\n")
    shutil.move(folder.parent / "out" / "run.json", folder / "run.json")
    (folder.parent / "out" / "run.json").symlink_to(folder / "run.json")
    return folder / "run.json"


def applied(path: Path) -> bytes:
    """What landmarks become by the run whose record is at `path`."""
    result = Result.load(path.parents[1] / "out")
    done = apply(result, path.parents[1] / "points.csv", path.parents[1] / "applied", force=True)
    return done.target.read_bytes() + result.record["status"].encode()


def scenario(folder: Path) -> Path:
    for name, content in (("head.nii.gz", by_nibabel("head.nii.gz")), ("cut.mrk.json", of_bytes(
            "cut.mrk.json", CUT.encode)), ("surface.csv", seed("table", -1))):
        content(folder.parent)
        assert (folder.parent / name).exists()
    (folder.parent / "case.toml").write_bytes(SEEDS["scenario"]()[1])
    shutil.move(folder.parent / "case.toml", folder / "case.toml")
    return folder / "case.toml"


def configured(path: Path) -> bytes:
    """What a run would be of, with the scenario where its files are."""
    there = Path(shutil.copy(path, path.parents[1] / "case.toml"))
    return repr(configure(scenario=there)).encode()


def cache(folder: Path) -> Path:
    """The small entries of a run's cache, and beside them what they were made of."""
    kept = Path(finished().name) / "cache"
    large = {path.parent.name for path in kept.glob("entries/*/*/value.npz") if path.stat().st_size > 20_000}
    for place in (folder / "cache", folder.parent / "again"):
        shutil.copytree(kept, place, ignore=lambda _, names: large & set(names))
    return folder / "cache"


def obtained(path: Path) -> bytes:
    """The content of all entries, which are made anew where they are damaged."""
    found, store, came = b"", Cache(path), set()
    for again in sorted((path.parents[1] / "again" / "entries").glob("*/*")):
        def build(folder, again=again):
            shutil.copytree(again, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("manifest.json"))

        entry, how = store.obtain(again.name, build)
        came.add(how)
        found += json.dumps(entry.files, sort_keys=True).encode()
        assert all((entry.folder / name).read_bytes() == (again / name).read_bytes() for name in entry.files)
    shutil.rmtree(path / "damaged")
    if came != {"cached"}:
        raise Anew
    return found


def compiled(folder: Path) -> Path:
    """Kernels under their seal, as the next process finds them."""
    Result.load(Path(finished().name) / "out").to_current([[0.0, 0.0]])
    source = Path(os.environ["NUMBA_CACHE_DIR"])
    target = folder / source.name / "geometry_0"
    target.mkdir(parents=True)
    for path in sorted(source.glob("geometry_*/*.nb[ic]"), key=lambda path: path.stat().st_size)[:6]:
        shutil.copy(path, target)
    kernels._seal(target.parent)
    shutil.copytree(folder, folder.parent / "again")
    return folder


def verified(path: Path) -> bytes:
    """The kernels that are left after the check of a new process; each is as it was sealed."""
    before = os.environ["NUMBA_CACHE_DIR"]
    os.environ["NUMBA_CACHE_DIR"] = str(path)
    try:
        kernels.settle_kernel_cache()
    finally:
        os.environ["NUMBA_CACHE_DIR"] = before
    again = path.parent / "again"
    left = {kernel.relative_to(path): kernel.read_bytes() for kernel in sorted(path.rglob(kernels.COMPILED))}
    assert all((again / name).read_bytes() == content for name, content in left.items()), "a damaged kernel was left"
    if len(left) < len([*again.rglob(kernels.COMPILED)]):
        shutil.copytree(again, path, dirs_exist_ok=True)
        raise Anew
    return b"".join(left.values())


SYNTAXES = {"native": ExplicitVRLittleEndian, "deflated": DeflatedExplicitVRLittleEndian, "RLE": RLELossless,
            "JPEG": JPEGLosslessSV1, "JPEG 2000": JPEG2000Lossless}
FORMATS = {
    "nii": Format(by_nibabel("a.nii"), image),
    "nii.gz": Format(by_nibabel("a.nii.gz"), image, whole),
    "nrrd raw": Format(by_itk("a.nrrd", False), image),
    "nrrd gzip": Format(by_itk("a.nrrd", True), image, behind(b"\n\n")),
    "nrrd detached": Format(by_itk("a.nhdr", False), image),
    "nrrd detached gzip": Format(by_itk("a.nhdr", True), image,
                                 lambda content: whole(content) if content.startswith(b"\x1f\x8b") else []),
    "mha raw": Format(by_itk("a.mha", False), image),
    "mha zlib": Format(by_itk("a.mha", True), image, behind(b"ElementDataFile = LOCAL\n")),
    "mhd": Format(by_itk("a.mhd", False), image),
    "mhd zlib": Format(by_itk("a.mhd", True), image,
                       lambda content: [] if content.startswith(b"ObjectType") else whole(content)),
    "mgh": Format(by_nibabel("a.mgh", nibabel.MGHImage), image),
    "mgz": Format(by_nibabel("a.mgz", nibabel.MGHImage), image, whole),
    **{f"dicom {name}": Format(series(syntax), image) for name, syntax in SYNTAXES.items()},
    **{f"vtu {name}": Format(of_bytes("a.vtu", lambda number=number: SEEDS["vtu"]()[number]), mesh, covered)
       for number, (name, covered) in enumerate((("ascii", none), ("binary", none),
                                                 ("zlib", arrays), ("lzma", arrays)), 1)},
    "solution.vtu": Format(of_run("head_solution.vtu"), mesh, arrays),
    **{name: Format(of_bytes(f"a.{name.rpartition('.')[2]}", lambda content=content: content), surface,
                    arrays if name in ("zlib/lps.vtp", "mni.gii") else none)
       for name, content in SURFACES.items()},
    **{name: Format(tractogram(f"a.{name}"), tracts, covered)
       for name, covered in (("trk", none), ("tck", none), ("trk.gz", whole))},
    **{f"{name} {number}": Format(seed("table", number), points)
       for number, name in enumerate(("csv", "csv", "tsv", "fcsv", "tag"))},
    "measured csv": Format(seed("table", -1), lambda path: repr(read_displacements(path)).encode()),
    "mrk.json": Format(of_bytes("a.mrk.json", CUT.encode), points),
    "field nii.gz": Format(of_run("head_desc-field_xfm.nii.gz"), field, whole),
    "transform h5": Format(of_run("head_desc-updated_xfm.h5"), image, whole),
    "run.json": Format(record, applied),
    "scenario.toml": Format(scenario, configured),
    "cache": Format(cache, obtained, whole),
    "kernels": Format(compiled, verified, whole),
}
