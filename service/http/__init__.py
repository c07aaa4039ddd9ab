"""HTTP: the layers in front of the application, the parsers of bodies, the routes."""
