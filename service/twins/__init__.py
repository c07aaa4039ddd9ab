"""The registered twins in memory, and which models fit them."""
