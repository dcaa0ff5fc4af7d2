"""From values to integers and back: the lattice of each channel, steps of bands, and errors measured."""
