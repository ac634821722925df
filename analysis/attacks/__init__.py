"""Attacks on a running service, kills and forbidden calls: nothing may break, leak or answer wrongly."""
