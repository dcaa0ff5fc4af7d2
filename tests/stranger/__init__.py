"""A decoder of containers written from docs/format.md alone: plain Python, clarity over speed."""
