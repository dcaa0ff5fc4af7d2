"""Surfaces published in a folder or a bucket: containers, the page that shows them, and the list of their names."""
