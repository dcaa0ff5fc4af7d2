"""Entropy coding of bit-planes: tiles, contexts, range coder and class coder, masks, and dequantisation."""
