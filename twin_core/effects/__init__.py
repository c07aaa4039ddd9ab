"""One missing-physics effect per file, and the registry of them."""
