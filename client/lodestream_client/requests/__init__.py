"""Requests over HTTP: addresses, bodies, and answers that are checked before use."""
