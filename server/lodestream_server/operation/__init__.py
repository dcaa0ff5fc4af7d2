"""Operation: settings, logs, metrics, and turns of the event loop."""
