"""``lodestream open``: a page for a browser on this machine; ``lodestream view``: pictures of what it shows."""
