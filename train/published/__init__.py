"""The receiver as published: what the paper did, rebuilt to be compared with."""
