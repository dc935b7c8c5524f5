"""The program `forcegp`. An interrupt ends it from its first import on."""

import os

from forcegp.interrupt import end_when_interrupted

end_when_interrupted()
# Threads that wait for work spin by default. Where other programs run, a fit then takes five times as long.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from forcegp.cli import main  # noqa: E402

if __name__ == "__main__":
    main()
