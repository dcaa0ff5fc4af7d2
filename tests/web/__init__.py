"""What the tests of `client/web` ask of the Python library: the same decisions, and servers."""
