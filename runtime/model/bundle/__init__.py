"""What export writes and the runtime loads."""
