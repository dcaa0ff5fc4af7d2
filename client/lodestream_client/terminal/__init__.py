"""What a person sees at a terminal: output that is escaped, and how an interrupt ends a command."""
