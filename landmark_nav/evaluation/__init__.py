"""Bags through the pipelines, measured against truth and drawn."""
