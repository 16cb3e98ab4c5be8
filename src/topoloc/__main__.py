"""`python -m topoloc` is `topoloc`."""

import sys

from topoloc.apps.cli import main

if __name__ == "__main__":
    sys.exit(main())
