"""The nominal device (profile) and the true one (state)."""
