"""Maps that are there: checked, compared, joined."""
