"""Where to look: the three landmarks with the best expected fix."""
