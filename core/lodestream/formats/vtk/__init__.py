"""Files that VTK reads, and structured grids of VTK written."""
