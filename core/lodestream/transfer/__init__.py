"""Both ends of a transmission, without I/O: the sender, downloads, and received data."""
