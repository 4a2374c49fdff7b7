"""Label maps of gliomas as networks and readers draw them: nested, ragged, and full of specks.

Labels as in the BraTS challenge: necrosis 1, oedema 2, enhancing tumour 4. The core, what is taken out, is 1 and 4.
"""

import numpy as np
from scipy import ndimage

NECROSIS, OEDEMA, ENHANCING = 1, 2, 4
CORE = (NECROSIS, ENHANCING)


def tumour(rng: np.random.Generator, shape, spacing, centre, radius_mm: float = 14.0) -> np.ndarray:
    """Labels (n1, n2) uint8 on a slice, whose core is about `radius_mm` large about `centre` (2,) mm from pixel (0, 0).

    An uneven rim of enhancing tumour, here and there broken, lies about the necrosis, and oedema about both; one pixel
    in a hundred or so has a neighbouring label. Same state of `rng`, same map.
    """
    spacing = np.asarray(spacing, float)
    away = np.moveaxis(np.indices(shape), 0, -1) * spacing - centre
    angle = rng.uniform(0, np.pi)
    along, across = away @ [np.cos(angle), np.sin(angle)], away @ [-np.sin(angle), np.cos(angle)]
    depth = radius_mm - np.hypot(along * rng.uniform(0.75, 0.9), across * rng.uniform(1.0, 1.3))
    depth += _noise(rng, shape, 8.0 / spacing, 0.2 * radius_mm) + _noise(rng, shape, 2.0 / spacing, 0.8)
    rim = rng.uniform(0.2, 0.4) * radius_mm + _noise(rng, shape, 4.0 / spacing, 0.15 * radius_mm)
    swollen = depth + rng.uniform(0.4, 0.8) * radius_mm + _noise(rng, shape, 6.0 / spacing, 0.15 * radius_mm)
    labels = np.select([(depth > 0) & (depth > rim), depth > 0, swollen > 0], [NECROSIS, ENHANCING, OEDEMA], 0)
    for label, where, size in ((ENHANCING, OEDEMA, 1.0), (NECROSIS, OEDEMA, 0.8), (OEDEMA, ENHANCING, 0.8),
                               (OEDEMA, NECROSIS, 0.8), (ENHANCING, NECROSIS, 1.2)):
        speckle = _noise(rng, shape, size / spacing, 1.0) > 2.4
        labels[speckle & (labels == where)] = label
    return labels.astype(np.uint8)


def _noise(rng, shape, sigma, height):
    """A smooth random field (n1, n2) of standard deviation `height`, correlated over `sigma` (2,) pixels."""
    field = ndimage.gaussian_filter(rng.normal(size=shape), sigma, mode="wrap")
    return height * field / field.std()
