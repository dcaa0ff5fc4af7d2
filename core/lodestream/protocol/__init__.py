"""Messages of a stream, their bytes, and the state machine of a connection. No I/O."""
