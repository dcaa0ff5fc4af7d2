"""Point cloud files of PCL."""
