"""How much a decoded page carries, and how well calibrated its confidences are."""
