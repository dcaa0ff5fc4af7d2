"""Streams that go on after lost connections, for synchronous and asyncio programs."""
