"""``lodestream view``: the page of a browser, served on this machine, and pictures of what it would show."""
