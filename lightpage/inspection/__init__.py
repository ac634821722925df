"""What a file is, how it fits a device, and what can be done with it next; by samples, in about a second."""
