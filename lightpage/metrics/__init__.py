"""How much a decoded page carries, and how honest its confidences are."""
