"""Making containers and levels: the queue of builds, and the processes that run untrusted work."""
