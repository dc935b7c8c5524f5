"""Run the command line with `python -m forcegp`, even if the `forcegp` script is not on the PATH."""

from forcegp.cli import main

if __name__ == "__main__":
    main()
