"""Check, comparison and merge of existing maps."""
