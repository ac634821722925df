"""How the image is found, followed and confirmed."""
