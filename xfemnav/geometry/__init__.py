"""Meshes, cuts and what a cut does to a mesh. Knows no images, no physics, no files."""
