"""What a device should be (profile) and what it is (state)."""
