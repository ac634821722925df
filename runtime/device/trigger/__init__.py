"""What fires both cameras at once."""
