"""How many levels a symbol may have: it is stored in one byte."""

MIN_LEVELS = 2
MAX_LEVELS = 256
