"""The command `python -m experts`."""

import sys

from experts.command import main

if __name__ == "__main__":
    sys.exit(main())
