"""Faults of one line, planted one by one to see which of them the tests find."""
