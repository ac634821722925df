"""The display of the device: pages that a controller uploads, the orders that it watches, and shutters."""
