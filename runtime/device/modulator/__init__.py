"""The writer: what shows a page, and what blocks the beams."""
