"""The server's data over a store of the core: immutable objects, and an index that can be thrown away."""
