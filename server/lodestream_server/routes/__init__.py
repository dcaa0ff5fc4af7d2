"""The routes of HTTP and WebSocket, and the documents that describe them."""
