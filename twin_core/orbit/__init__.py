"""A spacecraft in orbit around the Earth: where it is, where the Sun stands, and what falls on its faces."""
