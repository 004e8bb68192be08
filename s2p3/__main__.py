"""`python -m s2p3`: the command line, where the script `s2p3` is not on the path."""

import sys

from s2p3.cli import main

if __name__ == "__main__":
    sys.exit(main())
