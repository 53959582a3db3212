"""``python -m piga``: the command line where the program ``piga`` is not on the path."""

from piga.cli.main import main

if __name__ == "__main__":
    main()
