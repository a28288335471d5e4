"""Batches of many recordings: a file of runs, their stages as processes, and one table."""
