"""How well a calibration explains the light: a verdict, maps, and the likeliest cause."""
