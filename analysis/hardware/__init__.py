"""Measurements of the hardware side: cameras, trigger, pairing, the loop."""
