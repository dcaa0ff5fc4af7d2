"""From a surface to a container."""
