"""Looks at any file: its kind, its fit to a device, and what can be done with it next; by samples, in a second."""
