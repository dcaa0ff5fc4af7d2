"""Coordinates that follow a rule: height fields, places on the map, seams and angles."""
