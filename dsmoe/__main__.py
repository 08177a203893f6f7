"""python -m dsmoe: the `dsmoe` command."""
from __future__ import annotations

import sys


def main() -> int:
    """The command; a Ctrl-C before it has been loaded shows no traceback either."""
    try:
        from .cli import main as command
    except KeyboardInterrupt:
        print("\ndsmoe: interrupted", file=sys.stderr)
        return 130
    return command()


if __name__ == "__main__":
    sys.exit(main())
