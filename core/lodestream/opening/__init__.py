"""Containers wherever they are, opened lazily: a file, bytes, a bucket, or what the client adds by its entry points."""
