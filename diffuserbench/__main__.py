"""``python -m diffuserbench`` is ``diffuserbench``, where its script is not on the path."""

import sys

from instrument.cli import console

if __name__ == "__main__":
    sys.exit(console())
