"""Surfaces as objects of other libraries, and back: xarray, pyvista, trimesh, zarr; imported on use."""
