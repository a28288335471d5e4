"""`python -m landmark_nav` is `landmark-nav`."""

import sys

from landmark_nav.cli.main import main

sys.exit(main())
