"""An independent conforming reference: gmsh with the cut embedded, split nodes, scikit-fem P2.

It imports nothing of xfemnav, and xfemnav nothing of it.
"""
