"""`python -m jaxreg` is the command `jaxreg`."""

import sys

from jaxreg.cli.main import main


if __name__ == "__main__":
    sys.exit(main())
