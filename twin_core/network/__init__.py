"""The declared thermal network: its specification, its arrays and its heat balance."""
