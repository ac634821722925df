"""For those who call the service."""
