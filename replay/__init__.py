"""The replayer: streams recordings into a running service over HTTP."""
