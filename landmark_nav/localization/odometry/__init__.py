"""What wheels measure, and how far it is to be trusted."""
