"""The finite element space: basis functions on parts, and quadrature."""
