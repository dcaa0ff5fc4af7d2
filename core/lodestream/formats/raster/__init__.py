"""Rasters, most of them read by GDAL."""
