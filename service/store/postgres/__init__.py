"""PostgreSQL: one database for many processes."""
