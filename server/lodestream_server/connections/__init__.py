"""Connections with limits on waiting, reading and frames, below the framework."""
