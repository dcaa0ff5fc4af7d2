"""Checking and repairing the data of a server that does not run. Above `builds`, which describes containers."""
