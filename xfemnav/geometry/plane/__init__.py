"""The plane: outlines, meshes of triangles, cuts and resections drawn in it, and how they split its cells."""
