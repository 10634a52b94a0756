"""``python -m lsst.fringe_sim`` is ``fringe-sim``."""

from .cli import main

if __name__ == "__main__":
    main()
