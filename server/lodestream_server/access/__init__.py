"""Access control and limits on concurrent use."""
