"""The old name of `python -m runtime.config.reference`."""

import sys

from runtime.config.reference import main

if __name__ == "__main__":
    print(
        "python -m runtime.config_reference is now called python -m runtime.config.reference", file=sys.stderr
    )
    sys.exit(main())
