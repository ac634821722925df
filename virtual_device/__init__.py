"""A simulated device that looks like hardware: cameras, pulse generator, modulator."""
