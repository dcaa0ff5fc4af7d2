"""The hierarchy: lifting in integers, the pyramid of all levels, and the paper's mathematics in floating point."""
