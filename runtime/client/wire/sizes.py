"""Sizes of messages that both ends keep to."""

MESSAGE_BYTES = 4 << 20
"""One message in: chunks stay far below, so that no single message makes the service hold its breath."""

CHUNK_BYTES = 1 << 20
"""Chunk that a client sends: larger ones gain nothing, smaller ones cost calls."""

REPLY_BYTES = 64 << 20
"""One reply: symbols, float32 confidence, concentration and phase of 700 x 450 symbols are 4 MB."""
