"""What goes into the archive, what changes it afterwards, and what leaves it."""
