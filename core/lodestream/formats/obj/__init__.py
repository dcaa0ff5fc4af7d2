"""Wavefront OBJ files."""
