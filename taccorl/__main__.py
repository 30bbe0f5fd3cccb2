"""``python -m taccorl VERB``: the command line ``taccorl``."""

import sys

from taccorl.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
