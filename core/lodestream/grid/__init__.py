"""Where points, levels, subbands and tiles lie, and how blocks are connected: geometry without values."""
