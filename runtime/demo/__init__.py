"""The main job on a simulated device."""
