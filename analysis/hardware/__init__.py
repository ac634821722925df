"""How well drivers of hardware stand up to it, measured on simulated devices."""
