"""What an operator sees and sets: settings, logs, metrics, and turns of the event loop."""
