"""The program `forcegp`. An interrupt ends it from its first import on."""

from forcegp.interrupt import end_when_interrupted

end_when_interrupted()

from forcegp.cli import main  # noqa: E402

if __name__ == "__main__":
    main()
