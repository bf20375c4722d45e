"""`python -m harness` is `motorhil`."""

import sys


def start() -> int:
    """The command line has been obeyed; the exit status. Ctrl-C counts from here on."""
    try:
        from harness.cli import main
    except KeyboardInterrupt:
        sys.stderr.write("motorhil: interrupted\n")
        return 130
    return main()


if __name__ == "__main__":
    sys.exit(start())
