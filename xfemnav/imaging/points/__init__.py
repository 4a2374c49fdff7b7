"""Files of points, tracts and surfaces, read and put back."""
