"""From a frame pair to symbols, page after page."""
