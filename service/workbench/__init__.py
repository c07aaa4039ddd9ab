"""The science behind one small door: the interface, and twin_core behind it."""
