"""The old name of `python -m runtime.clients.channel`."""

import sys

from runtime.clients.channel.__main__ import main

if __name__ == "__main__":
    print("python -m runtime.channel is now called python -m runtime.clients.channel", file=sys.stderr)
    sys.exit(main())
