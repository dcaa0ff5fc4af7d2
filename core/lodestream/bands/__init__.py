"""Containers of surfaces that do not fit into memory: encoded band by band, by one process or by many."""
