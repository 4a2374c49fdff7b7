"""nibabel without pydicom, which it would load for a header extension of NIfTI that nothing here reads: in as much time
as nibabel itself takes. Whoever has loaded either of them already keeps what they have."""

import sys

if not {"nibabel", "pydicom"} & set(sys.modules):
    sys.modules["pydicom"] = None  # cannot be imported, until it is taken away again
    try:
        import nibabel
    finally:
        del sys.modules["pydicom"]

import nibabel

__all__ = ["nibabel"]
