"""Slices and frames, segmentation, outline, warp. The only home of SimpleITK, nibabel and scikit-image."""
