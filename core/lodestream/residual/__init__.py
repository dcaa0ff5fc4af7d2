"""The difference between lattice and original values, in chunks that are coded without loss."""
