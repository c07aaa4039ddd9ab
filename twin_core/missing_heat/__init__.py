"""The heat that the declared model lacks, as the report shows it: smoothed, and what drives it."""
