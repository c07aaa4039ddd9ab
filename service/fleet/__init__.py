"""Several service processes on one database: who owns which twin's live state, and how they hear of each other."""
