"""Both ends of one transmission, without I/O: the sender, downloads, and what has been received."""
