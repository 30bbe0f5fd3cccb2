"""``python -m pipelines.benchmarks [--only=name]``"""

import sys

from pipelines.benchmarks.run import main

if __name__ == "__main__":
    sys.exit(main())
