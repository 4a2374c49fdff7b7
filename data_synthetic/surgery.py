"""An operation on the MNI152 brain as files: `xfemnav example surgery FOLDER`.

nilearn's T1 image, cut down to the slab about the operation, gets a ring-enhancing tumour in the left frontal lobe.
With it go a label map of the tumour and the ventricles, the probability of grey matter in larger voxels, a bundle of
fibres with their direction as an image, and targets. The scenario has the operation in five steps.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import nibabel as nib
import numpy as np
from scipy.ndimage import gaussian_filter, label

VOLUMES = "datasets/data/mni_icbm152_{}_tal_nlin_sym_09a_converted.nii.gz"
SLAB = 8.0, 28.0                            # mm, from inferior to superior
VENTRICLE, TUMOUR = 4, 7                    # labels
CENTRE, SEMI_AXES = np.array([-29.0, 22.0, 18.0]), np.array([11.0, 8.0, 9.0])    # mm, of the tumour
RIM_MM = 2.5                                # of enhancing tumour about its dark core
CSF_BELOW = 120                             # intensity of the T1 image
BUNDLE, SLIMNESS = np.array([-3.0, -10.0]), 1.6    # mm; fibres run on ellipses about it, so much longer than wide
TARGETS = {"on the cut": (-47.25, 36.5), "front wall": (-20.0, 33.0), "back wall": (-42.0, 15.0),
           "tumour": (-29.0, 22.0), "caudate": (-14.0, 10.0)}    # mm, in the slice at 18 mm
SCENARIO = Path(__file__).with_name("surgery.toml")


def brain(kind: str = "t1") -> tuple[np.ndarray, np.ndarray]:
    """The slab of nilearn's image 't1', or 'gm' for grey matter: values (ni, nj, nk) and affine (4, 4), RAS mm."""
    volume = nib.load(Path(find_spec("nilearn").submodule_search_locations[0]) / VOLUMES.format(kind))
    low, high = (round(z - volume.affine[2, 3]) for z in SLAB)
    slab = volume.slicer[:, :, low:high + 1]
    return slab.get_fdata(), slab.affine


def places(shape, affine) -> np.ndarray:
    """World mm (ni, nj, nk, 3) of the voxels."""
    return np.moveaxis(np.indices(shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]


def labels(image, affine) -> np.ndarray:
    """Label map (ni, nj, nk) uint8 of the tumour and the lateral ventricles."""
    at = places(image.shape, affine)
    dark = (image < CSF_BELOW) & (image > 0) & (abs(at[..., 0]) < 32) & (at[..., 1] > -52) & (at[..., 1] < 24)
    bodies, _ = label(dark)
    ventricles = np.isin(bodies, 1 + np.argsort(-np.bincount(bodies.ravel())[1:])[:2])
    inside = (((at - CENTRE) / SEMI_AXES) ** 2).sum(axis=-1) < 1
    return np.select([inside, ventricles], [TUMOUR, VENTRICLE], 0).astype(np.uint8)


def with_tumour(image, affine) -> np.ndarray:
    """The image with a dark core and a bright rim, blurred as a scanner would."""
    radius = np.sqrt((((places(image.shape, affine) - CENTRE) / SEMI_AXES) ** 2).sum(axis=-1))
    painted = np.where(radius < 1 - RIM_MM / SEMI_AXES.mean(), 90.0, np.where(radius < 1, 250.0, image))
    share = np.clip(2 * gaussian_filter((radius < 1).astype(float), 0.7), 0, 1)
    return (1 - share) * image + share * gaussian_filter(painted, 0.7)


def coarse(values, affine) -> tuple[np.ndarray, np.ndarray]:
    """Means of `values` (ni, nj, nk) in voxels of three times the size, float32, and their affine (4, 4)."""
    n = np.array(values.shape) // 3
    blocks = values[tuple(slice(0, 3 * k) for k in n)].reshape(n[0], 3, n[1], 3, n[2], 3)
    wide = affine @ np.diag([3.0, 3.0, 3.0, 1.0])
    wide[:3, 3] = (affine @ [1.0, 1.0, 1.0, 1.0])[:3]
    return blocks.mean(axis=(1, 3, 5)).astype(np.float32), wide


def directions(at) -> np.ndarray:
    """Unit direction (..., 3) RAS of the fibres at places (..., 3) mm: along ellipses about BUNDLE, backwards."""
    x, y = np.moveaxis(at[..., :2] - BUNDLE, -1, 0)
    along = np.stack([-y / SLIMNESS**2, x, np.zeros_like(x)], axis=-1)
    return along / np.maximum(np.linalg.norm(along, axis=-1), 1e-9)[..., None]


def fibres() -> list[np.ndarray]:
    """Streamlines (n, 3) mm of the left hemisphere, from front to back."""
    angle = np.linspace(np.deg2rad(115), np.deg2rad(245), 120)
    return [np.stack([BUNDLE[0] + a * np.cos(angle), BUNDLE[1] + SLIMNESS * a * np.sin(angle), np.full(120, z)], axis=1)
            for a in np.arange(26.0, 46.0, 2.0) for z in (17.8, 18.0, 18.2)]


def write(folder) -> dict[str, Path]:
    """Write all files in `folder`, made if need be; returns role: path. Two calls give the same bytes."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (image, affine), (grey, _) = brain(), brain("gm")
    images = {
        "image": ("sub-mni_T1w", np.rint(with_tumour(image, affine)).astype(np.uint8)),
        "labels": ("sub-mni_dseg", labels(image, affine)),
        "direction": ("sub-mni_desc-fibre_direction", directions(places(image.shape, affine)).astype(np.float32)),
        "grey": ("sub-mni_label-GM_probseg", *coarse(grey / grey.max(), affine)),
    }
    paths = {role: folder / f"{stem}.nii.gz" for role, (stem, *_) in images.items()}
    for role, (_, values, *own) in images.items():
        nib.save(nib.Nifti1Image(values, *(own or [affine])), paths[role])
    paths |= {"fibres": folder / "fibres.tck", "targets": folder / "targets.csv", "scenario": folder / SCENARIO.name}
    nib.streamlines.save(nib.streamlines.Tractogram(fibres(), affine_to_rasmm=np.eye(4)), str(paths["fibres"]))
    rows = [f"{x:g},{y:g},18,{name}" for name, (x, y) in TARGETS.items()]
    paths["targets"].write_text("\n".join(["r,a,s,label", *rows]) + "\n")
    paths["scenario"].write_text(SCENARIO.read_text(encoding="utf-8"), encoding="utf-8")
    return paths


if __name__ == "__main__":
    for path in write(sys.argv[1]).values():
        print(path)
