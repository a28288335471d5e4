"""`python -m landmark_nav` is `landmark-nav`."""

import sys

from landmark_nav.executables import command

if __name__ == '__main__':
    sys.exit(command())
