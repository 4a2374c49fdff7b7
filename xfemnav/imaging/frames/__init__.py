"""Slices and frames: RAS and LPS, voxel order, affines."""
