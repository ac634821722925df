"""How a decoder comes to be, from recording to run."""
