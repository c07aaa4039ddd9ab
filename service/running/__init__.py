"""What lives as long as the process: the service, its background tasks, and its part in a fleet."""
