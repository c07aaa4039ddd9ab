"""Models of other tools as specifications: text in, plain data out, and a line for everything that has no counterpart here."""
