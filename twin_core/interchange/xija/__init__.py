"""Xija models (JSON), as they fly at the Chandra observatory."""
