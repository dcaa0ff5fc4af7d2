"""From slices of a container to views of the surface."""
