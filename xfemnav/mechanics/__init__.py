"""Linear elasticity on a cut mesh: branch functions, enrichment, constraints, solve. Knows no images, no files."""
