"""The finite-element simulator of orbits: mesh, forms, time stepping, scenario files."""
