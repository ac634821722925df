"""Pages that the service reads from its own source, and the bytes on them."""
