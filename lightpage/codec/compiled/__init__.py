"""The page code's arithmetic in C, where a compiler was at the installation; its twins in numpy give the same bits."""
