"""The page code's arithmetic in C, where a compiler was when this was installed; its twins in numpy give the same bits."""
