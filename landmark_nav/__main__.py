"""`landmark-nav`, also as `python -m landmark_nav`: heeds signals first, then imports."""

from __future__ import annotations

import sys

from landmark_nav.signals import end_at_once

end_at_once()


def main() -> int:
    """Entry point of the executable."""
    from landmark_nav.cli.main import main as run

    return run()


if __name__ == '__main__':
    sys.exit(main())
