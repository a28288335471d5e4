"""What wheels tell, and how far it is to be trusted."""
