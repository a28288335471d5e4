"""`landmark-nav completion`: print the completion script of a shell."""

from __future__ import annotations

import argparse

from argcomplete.shell_integration import shellcode


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.description = (
        'Print the lines that make a shell complete commands and options of landmark-nav. Add '
        'them to ~/.bash_completion, ~/.zshrc, or ~/.config/fish/completions/landmark-nav.fish.'
    )
    parser.add_argument('shell', choices=('bash', 'zsh', 'fish'))


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    print(shellcode(['landmark-nav'], shell=args.shell))
    return 0
