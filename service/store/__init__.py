"""The embedded store: one file, one writer, parallel readers. Each table's SQL lives in the module of its name."""
