"""PLOT3D grids."""
