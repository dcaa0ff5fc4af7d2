"""Terminal: escaped output, and the end of a command after an interrupt."""
