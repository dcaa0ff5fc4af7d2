"""Bytes, speed and memory of this project beside the coders that one would take instead: ``make bench-peers``."""
