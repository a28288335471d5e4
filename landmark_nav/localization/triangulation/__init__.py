"""A pose from bearings."""
