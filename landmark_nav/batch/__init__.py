"""Many recordings at once: a file of runs, their stages as processes, one table."""
