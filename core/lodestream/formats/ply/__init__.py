"""PLY files: meshes, curves and range grids."""
