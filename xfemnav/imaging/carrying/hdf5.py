"""ITK's transform file: HDF5 made in memory, without clocks, so that the same transforms give the same bytes.

It is written to the disk like any other file: HDF5 itself, on a full disk, leaves by an error that nobody can catch, or
takes the process with it.
"""

import io

import numpy as np


def transform_bytes(transforms) -> bytes:
    """The .h5 file of `transforms`: ITK's name, fixed parameters and parameters of each, as
    `itk::HDF5TransformIO` lays them out. A composite has no parameters, and its parts follow it."""
    import h5py  # takes as long to load as a small slice to warp

    memory = io.BytesIO()
    with h5py.File(memory, "w", libver="earliest") as file:
        for k, (name, fixed, parameters) in enumerate(transforms):
            group = file.create_group(f"TransformGroup/{k}")
            group.create_dataset("TransformType", data=[name], dtype=h5py.string_dtype("ascii"), track_times=False)
            for field, values in (("TransformFixedParameters", fixed), ("TransformParameters", parameters)):
                if len(values):
                    group.create_dataset(field, data=np.asarray(values, "<f8"), track_times=False)
    return memory.getvalue()
