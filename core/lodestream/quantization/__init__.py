"""From values to integers and back: the lattice of each channel, quantization steps of bands, and errors measured."""
