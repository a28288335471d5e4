"""Runs of the pipelines on bags: metrics against ground truth, reports and figures."""
