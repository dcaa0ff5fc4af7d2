"""What a receiver needs of a container, and in which order: plans, regions, byte ranges, without I/O and decoding."""
