"""Surfaces as the objects of other libraries, and back: xarray, pyvista, trimesh, zarr; loaded on use."""
