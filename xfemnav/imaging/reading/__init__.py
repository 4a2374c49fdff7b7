"""One door for images: every format becomes voxels and where they lie, or one coded error."""
