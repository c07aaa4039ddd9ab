"""The report of a closed loop: what it says, and the page that shows it."""
