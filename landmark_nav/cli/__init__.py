"""The commands, one module each: `add_arguments` says what one takes, `run` does it."""
