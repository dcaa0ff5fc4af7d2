"""Containers and values stay as they are: what a change of the code must leave alone, byte for byte.

`python -m tests.unchanged record FOLDER` encodes many surfaces with the code as it is, and keeps the surfaces and
SHA-256 of their containers and of the values read from them. `python -m tests.unchanged compare FOLDER` does the same
with the code of later, from the surfaces that were kept, and prints what differs. `tests/core/test_unchanged.py` holds
a sample of the random surfaces to the digests in `sample.json`.
"""
