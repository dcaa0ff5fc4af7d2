"""Messages of a stream, their bytes, and the state machine of a connection, without I/O."""
