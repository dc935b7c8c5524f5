"""Run the command line with `python -m forcegp`, even if the script `forcegp` is not on the path."""

from forcegp.cli import main

if __name__ == "__main__":
    main()
