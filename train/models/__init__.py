"""Models: networks and the optics that they are trained with."""
