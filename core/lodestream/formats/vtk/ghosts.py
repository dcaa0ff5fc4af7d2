"""Bits of vtkGhostType, by which VTK hides points and cells; from its vtkDataSetAttributes.h."""

__all__ = ["HIDDEN_CELL", "HIDDEN_POINT"]

HIDDEN_POINT = 2
HIDDEN_CELL = 32
