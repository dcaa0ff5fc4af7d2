"""Checking the data of a server, and repairing them while none writes. Above `builds`, which describes containers."""
