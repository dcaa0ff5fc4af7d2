"""What a receiver needs of a container, and in which order: plans, regions, byte ranges. No I/O, no decoding."""
