"""Coordinates that follow a rule: height fields, geotransforms of levels, seams and angles."""
