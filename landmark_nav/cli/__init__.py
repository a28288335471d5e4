"""The commands, one module each: `add_parser` says what one takes, `run` does it."""
