"""Models: which one is in service, how others come in, and the store that keeps them."""
