"""Containers that must keep decoding to the same surfaces: ``NAME.lode``, and what they hold in ``expected.json``."""
