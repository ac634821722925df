"""What the device shows: pages that a controller uploads, the display that it watches, and shutters."""
