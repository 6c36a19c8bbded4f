"""Message encodings: bytes of many messages to arrays."""
