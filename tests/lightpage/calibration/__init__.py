"""Claims about registration."""
