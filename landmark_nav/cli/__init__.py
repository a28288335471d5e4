"""The `landmark-nav` command."""
